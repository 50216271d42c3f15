"""The command that starts this program in the user's shell, for the messages that it prints."""

from __future__ import annotations

import os
import shlex
import shutil
import sys
from pathlib import Path

from cleargs.subprocesses import module_command

PROGRAM = "CLEARGS_PROGRAM"
"""Environment variable with this command. A path in it is absolute."""


def name_program() -> None:
    """Store the command that starts this program in the environment, which child processes inherit.

    It is ``cleargs`` if the shell finds this installation under that name, or else the path of the program.
    """
    if PROGRAM in os.environ:
        return
    script, found = Path(sys.executable).with_name("cleargs"), shutil.which("cleargs")
    if found is not None and (Path(found) == script or Path(found) == Path(sys.argv[0]).absolute()):
        os.environ[PROGRAM] = "cleargs"
    else:
        os.environ[PROGRAM] = shlex.join([str(script)] if script.is_file() else module_command("cleargs"))


def program(folder: Path) -> str:
    """Return the command that starts this program in a shell whose working directory is ``folder``."""
    name, *others = shlex.split(os.environ.get(PROGRAM, "cleargs"))
    near = Path(name).is_relative_to(folder) and Path(name).parent != folder
    return shlex.join([str(Path(name).relative_to(folder)) if near else name, *others])
