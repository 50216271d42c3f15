"""The commands of ``cleargs``, in the groups of its help."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

from cleargs.program import program

SECTIONS: Mapping[str, Mapping[str, tuple[str, str]]] = {
    "Make": {
        "run": ("cleargs.cli.run", "Turn a capture into a clean scene."),
        "batch": ("cleargs.cli.batch", "Run all scenes of a sheet."),
        "demo": ("cleargs.cli.demo", "Make a small synthetic capture and run it."),
    },
    "Look": {
        "watch": ("cleargs.cli.report", "Follow a run in the browser, then see its report."),
        "report": ("cleargs.cli.report", "Write the report: the scene in 3D, and every frame."),
        "show": ("cleargs.cli.show", "Show the tables and figures of a run in the terminal."),
        "render": ("cleargs.cli.render", "Render pictures and films of the scene."),
    },
    "Take away": {
        "export": ("cleargs.cli.export", "Write the scene for a viewer or another program."),
        "pack": ("cleargs.cli.pack", "Pack a run into a ZIP file, to hand it on."),
    },
    "Measure": {
        "eval": ("cleargs.cli.eval", "Measure the quality of a scene with sharp images."),
        "diff": ("cleargs.cli.diff", "Compare the settings and figures of two runs."),
        "synth": ("cleargs.cli.synth", "Make a synthetic capture with known ground truth."),
    },
    "Look after": {
        "status": ("cleargs.cli.run", "Show which stages are done, and what changed if one is not."),
        "doctor": ("cleargs.cli.doctor", "Check this machine: versions, memory, disk, device."),
        "settings": ("cleargs.cli.settings", "List all settings with default, range and meaning."),
    },
    "More": {
        "models": ("cleargs.cli.models", "List, install and verify model weights."),
        "verify": ("cleargs.cli.store", "Check every file of a run for damage."),
        "gc": ("cleargs.cli.store", "Remove results that no run links to."),
        "stage": ("cleargs.cli.run", "Run one stage of a prepared run."),
        "completion": ("cleargs.cli.completion", "Print the script that completes commands in a shell."),
    },
}
"""Group -> command -> (module with the click command of that name, its line in the help of the program).

The help names the commands of the last group in one line.
"""

COMMANDS = {name: facts for commands in SECTIONS.values() for name, facts in commands.items()}
"""Command -> (module, line in the help)."""

ALIASES = {"explain": "status"}
"""Old name of a command -> its name."""

_PRINTED = re.compile(rf"(?<![\w./-])cleargs (?=(?:{'|'.join(COMMANDS)})\b)")


def as_called(text: str) -> str:
    """Return ``text`` with ``cleargs`` in its commands replaced by what the user must type here."""
    return _PRINTED.sub(lambda match: f"{program(Path.cwd())} ", text)
