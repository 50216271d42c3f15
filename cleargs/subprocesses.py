"""Command lines of Python child processes."""

from __future__ import annotations

import sys


def module_command(module: str, *arguments: str) -> list[str]:
    """Return the command ``python -m module arguments``, without the working folder on the import path.

    ``-P`` removes it. Otherwise a file ``json.py`` next to the user's photos would be imported, and run, in
    place of the module of the standard library.
    """
    return [sys.executable, "-P", "-m", module, *arguments]
