"""Plug-in for LichtFeld Studio: train on the frames that ClearGS chose and cleaned.

Copy this folder to ``~/.lichtfeld/plugins/``. docs/other-programs.md shows the steps.
"""

import lichtfeld as lf

from .panel import FramesPanel


def on_load():
    lf.register_class(FramesPanel)


def on_unload():
    lf.unregister_class(FramesPanel)
