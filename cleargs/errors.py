"""The errors a user may see: one line of cause (the message) and one line of remedy (the hint).

The command line turns each into its exit code and prints no traceback unless ``--debug`` is given.
"""

from __future__ import annotations

from collections.abc import Iterable
from difflib import get_close_matches


def did_you_mean(name: str, known: Iterable[str], otherwise: str) -> str:
    """The hint for an unknown name: the nearest of ``known``, or ``otherwise`` where none is near."""
    near = get_close_matches(name, list(known), n=1)
    return f"did you mean {near[0]}?" if near else otherwise


class CleargsError(Exception):
    """Base of every error that ClearGS raises on purpose: the work failed (exit code 1)."""

    exit_code = 1

    def __init__(self, message: str, *, hint: str) -> None:
        super().__init__(message)
        self.hint = hint


class InputError(CleargsError):
    """The input, a setting or a command-line argument cannot be used as it is (exit code 2)."""

    exit_code = 2


class ConfigError(InputError):
    """A recipe or a ``--set`` names an unknown field or a value out of range."""


class StageError(CleargsError):
    """A stage could not finish its work, although its input was readable."""


class StoreError(CleargsError):
    """The store cannot be read or written (full disk, missing permission)."""
