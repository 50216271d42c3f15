"""How Python child processes are started."""

from __future__ import annotations

import sys


def module_command(module: str, *arguments: str) -> list[str]:
    """``python -m module arguments``, without the working folder on its path.

    Without ``-P``, ``-m`` puts the working folder first: a file ``json.py`` beside the user's photos would be
    imported, and run, in place of the standard library's.
    """
    return [sys.executable, "-P", "-m", module, *arguments]
