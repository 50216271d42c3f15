"""Version of the source that made a page."""

from __future__ import annotations

import hashlib
import subprocess
from importlib.resources import files
from pathlib import Path

import cleargs

_DIGITS = 12


def version_of_source() -> str:
    """Return the package's version, ``git describe`` of the checkout if any, and a digest of the source."""
    described = _git_describe(Path(str(files("cleargs"))).parent)
    parts = [cleargs.__version__, *([described] if described else []), f"source {_digest()}"]
    return ", ".join(parts)


def _git_describe(checkout: Path) -> str | None:
    """Return ``git describe`` of a checkout; None without a checkout or without git."""
    if not (checkout / ".git").exists():  # an installed package may be inside another repository
        return None
    command = ["git", "-C", str(checkout), "describe", "--always", "--dirty", "--tags"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=20, check=True)
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip() or None


def _digest() -> str:
    """Return a digest of the paths and contents of all source and TOML files: package, stages and recipes."""
    digest = hashlib.sha256()
    for package in ("cleargs", "cleargs.stages", "cleargs.workflows"):
        folder = Path(str(files(package)))
        for file in sorted(path for path in folder.rglob("*") if path.suffix in (".py", ".toml")):
            digest.update(f"{package}/{file.relative_to(folder).as_posix()}\0".encode())
            digest.update(file.read_bytes())
    return digest.hexdigest()[:_DIGITS]
