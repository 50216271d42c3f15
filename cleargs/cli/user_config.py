"""The user's configuration file: defaults for new runs on this machine."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any

DEFAULTS = ("store", "device", "threads", "quality")
"""Entries of the file. ``threads`` is for all commands, the others only for new runs."""


def user_config_file() -> Path:
    """Return the path of the file, which need not exist: ``cleargs/config.toml`` in ``XDG_CONFIG_HOME``."""
    return Path(os.environ.get("XDG_CONFIG_HOME") or Path.home() / ".config") / "cleargs" / "config.toml"


def user_defaults(commands: Iterable[str]) -> dict[str, dict[str, Any]]:
    """Return command -> option -> default from the user's file, for click, which checks the values.

    Raises ConfigError if the file cannot be read, or has another entry than `DEFAULTS`.
    """
    path = user_config_file()
    if not path.is_file():
        return {}
    from cleargs.errors import ConfigError, did_you_mean
    from cleargs.pipeline.config import read_toml

    found = read_toml(path)
    for name in found:
        if name not in DEFAULTS:
            known = f"known: {', '.join(DEFAULTS)}; settings of stages go into a recipe"
            raise ConfigError(
                f"{path} has an unknown entry {name!r}", hint=did_you_mean(name, DEFAULTS, known)
            )
    if "store" in found:
        found["store"] = str(Path(str(found["store"])).expanduser())
    threads = {name: value for name, value in found.items() if name == "threads"}
    return {**dict.fromkeys(commands, threads), "run": found, "demo": found}
