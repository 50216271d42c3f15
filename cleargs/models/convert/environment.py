"""The environment for conversions: its packages would break the one ClearGS runs in (another OpenCV)."""

from __future__ import annotations

from importlib.util import find_spec

from cleargs.errors import InputError


def require(*packages: str, purpose: str) -> None:
    """Raise InputError if one of the packages cannot be imported here."""
    missing = [name for name in packages if find_spec(name) is None]
    if missing:
        raise InputError(
            f"{purpose} needs {' and '.join(missing)}, which this environment lacks",
            hint="run `make convert-env` once, then the same command with .venv-convert/bin/cleargs",
        )


def first_line(error: Exception) -> str:
    """What an error of another package says, in one line."""
    return (str(error).strip().splitlines() or [type(error).__name__])[0]
