"""The folder of installed models: which are there, and whether their files are what they should be."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Literal

from cleargs.errors import InputError
from cleargs.models.registry import Model, Role, load_registry, model_dir
from cleargs.untrusted import open_regular, read_json

State = Literal["shipped", "installed", "not installed", "incomplete"]


def state(model: Model, directory: Path) -> State:
    """Whether the model can be used, judged by the presence of its files alone."""
    if model.shipped is not None:
        return "shipped"
    present = [(directory / file.name).is_file() for file in model.files]
    if all(present):
        return "installed"
    return "incomplete" if any(present) else "not installed"


def installed_file(name: str, role: Role) -> Path | None:
    """The absolute path of the installed model of that name and role; None if the registry has none such.

    Raises InputError when it is not installed. Its content is not checked (see `verify`).
    """
    model = installable(name, role)
    if model is None:
        return None
    path = (model_dir() / model.files[0].name).absolute()
    if not path.is_file():
        raise InputError(f"the model {name} is not installed", hint=_install_hint(model))
    return path


def installable(name: str, role: Role) -> Model | None:
    """The registry's entry of that name and role, unless it comes with ClearGS."""
    found = (model for model in load_registry() if model.name == name and model.role == role)
    return next((model for model in found if model.shipped is None), None)


def verify(model: Model, directory: Path) -> None:
    """Check the files of an installed model, digest by digest, and that a shipped one is in its place.

    Raises InputError at the first one that is missing or differs from what the registry, or the receipt of
    the installation, says.
    """
    if model.shipped is not None:
        _verify_shipped(model.shipped)
        return
    for file in model.files:
        path = directory / file.name
        if not path.is_file():
            raise InputError(f"{path} is missing", hint=_install_hint(model))
        expected = file.digest or read_receipt(model, directory).get(file.name)
        if expected is None or file_digest(path) != expected:
            raise InputError(f"{path} is damaged", hint=f"{_install_hint(model)} again")


def write_receipt(model: Model, directory: Path, source_sha256: str) -> Path:
    """Note the digests of the source and of the files made of it."""
    digests = {file.name: file_digest(directory / file.name) for file in model.files}
    path = directory / _receipt_name(model)
    path.write_text(
        json.dumps({"model": model.name, "source_sha256": source_sha256, "files": digests}, indent=2) + "\n",
        "utf-8",
    )
    return path


def read_receipt(model: Model, directory: Path) -> dict[str, str]:
    """The digests of the installed files by name; none if there is no readable receipt."""
    try:
        files = read_json(directory / _receipt_name(model))["files"]
        return {str(name): str(digest) for name, digest in files.items()}
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return {}


def file_digest(path: Path) -> str:
    """SHA-256 in hexadecimal: of an ONNX file's bytes, or of the tensors in a safetensors file."""
    if path.suffix == ".safetensors":
        from cleargs.models.lpips import tensors_digest

        return tensors_digest(path)
    with open_regular(path) as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _receipt_name(model: Model) -> str:
    return f"{model.name}.receipt.json"


def _install_hint(model: Model) -> str:
    given = "" if model.source is None or model.source.spec != "file" else f" --from {model.source.file}"
    accepted = "" if model.commercial else " --accept-licence"
    return f"run `cleargs models install {model.name}{given}{accepted}`"


def _verify_shipped(name: str) -> None:
    path = Path(__file__).parent / name
    if not path.is_file():
        raise InputError(f"{path} is missing", hint="install ClearGS again")
    if path.suffix == ".onnx":
        from cleargs.models.onnx import OnnxModel

        OnnxModel(path)
