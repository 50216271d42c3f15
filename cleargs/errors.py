"""The errors a user may see: one line of cause (the message) and one line of remedy (the hint).

The command line turns each into its exit code and prints no traceback unless ``--debug`` is given.
"""

from __future__ import annotations


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
