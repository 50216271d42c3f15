"""Errors for users: the message names the cause, and the hint says what to do.

The command line turns each error into its exit code. It prints a traceback only with ``--debug``.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from difflib import get_close_matches


def did_you_mean(name: str, known: Iterable[str], otherwise: str) -> str:
    """Return a hint for an unknown name: the most similar name in ``known``, or ``otherwise`` without one."""
    near = get_close_matches(name, list(known), n=1)
    return f"did you mean {near[0]}?" if near else otherwise


def listed(items: Sequence[str]) -> str:
    """Return the first three items of a long list, and the number of the others."""
    return ", ".join(items[:3]) + (f" and {len(items) - 3} more" if len(items) > 3 else "")


class CleargsError(Exception):
    """Base class of all errors that ClearGS raises on purpose (exit code 1)."""

    exit_code = 1

    def __init__(self, message: str, *, hint: str) -> None:
        super().__init__(message)
        self.hint = hint


class InputError(CleargsError):
    """The input, a setting or a command-line argument cannot be used (exit code 2)."""

    exit_code = 2


class ConfigError(InputError):
    """A recipe or ``--set`` has an unknown name or a value out of range."""


class StageError(CleargsError):
    """A stage failed although its input was readable."""


class StoreError(CleargsError):
    """The store or another file cannot be read or written (full disk, missing permission)."""
