"""``manifest.json``: the last file written into a finished stage folder, and what makes it finished."""

from __future__ import annotations

import platform
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, Literal

from pydantic_core import to_jsonable_python

import cleargs
from cleargs.base_model import FrozenModel
from cleargs.digest import DigestMemo, json_digest
from cleargs.files import is_partial, write_json
from cleargs.safe_io import FAULTS, read_json

MANIFEST = "manifest.json"


SCHEMA = 1
"""Raised when the way keys are made changes: every old result becomes a miss."""

PRECISION = "float32"
"""Precision of the parameters that the stages train and publish."""


class KeyParts(FrozenModel):
    """What goes into the key of one stage."""

    stage: str
    version: int
    config: dict[str, Any]
    """The stage's own section, without the fields marked by `key_config` as outside the key."""
    inputs: dict[str, dict[str, str | None]]
    """Upstream stage -> declared path -> digest of its content; None where an optional path is absent."""
    externals: dict[str, str]
    """Role -> digest of the content of a file or folder outside the store."""
    seed: int
    device: Literal["cpu", "cuda"]
    libraries: dict[str, str]
    precision: str = PRECISION
    schema_version: int = SCHEMA

    @property
    def key(self) -> str:
        """sha256 of the canonical JSON, hexadecimal."""
        return json_digest(self.model_dump(mode="json"))


class FileRecord(FrozenModel):
    """One published file."""

    size: int
    digest: str


class Manifest(FrozenModel):
    """What a finished stage folder holds and what it was made from. Names no host and no absolute path."""

    stage: str
    key: str
    status: Literal["complete", "partial"]
    """`partial` when this stage or one before it is done only in part."""
    missing: tuple[str, ...]
    """What this stage could not make."""
    inherited: tuple[str, ...]
    """What the stages before it could not make, as "STAGE: what"."""
    parts: KeyParts
    """All that went into the key."""
    origins: dict[str, dict[str, str]]
    """"STAGE/PATH" (inputs) or role (externals) -> digests of the single files behind it."""
    files: dict[str, FileRecord]
    """Relative path -> size and digest of every file except this one."""
    digest: str
    """Digest of the whole tree."""
    versions: dict[str, str]
    started: str
    """UTC, ISO 8601."""
    seconds: float
    cpu_seconds: float | None = None
    """Processor time of all threads and child processes; None where an earlier version did the work."""
    peak_memory_gb: float | None = None
    """Largest resident memory of the process while the stage ran, GB (1e9 bytes)."""
    device: str
    summary: dict[str, Any]
    """The figures that the stage reports."""

    @property
    def bytes(self) -> int:
        """Size of all files together."""
        return sum(record.size for record in self.files.values())

    def under(self, path: str) -> dict[str, str]:
        """Digests of the file ``path``, or of all files in the folder ``path``; empty without either."""
        if path in self.files:
            return {"": self.files[path].digest}
        prefix = path.rstrip("/") + "/"
        return {
            name.removeprefix(prefix): record.digest
            for name, record in self.files.items()
            if name.startswith(prefix)
        }


def versions() -> dict[str, str]:
    """Versions worth noting beside the libraries that enter the key."""
    return {"cleargs": cleargs.__version__, "python": platform.python_version()}


def write_manifest(folder: Path, manifest: Manifest) -> None:
    """Write ``manifest`` into ``folder`` atomically, sealed by a digest of its own content."""
    content = manifest.model_dump(mode="json")
    write_json(folder / MANIFEST, {**content, "seal": json_digest(content)})


def read_manifest(folder: Path) -> Manifest:
    """Read and check the manifest in ``folder``.

    Raises FileNotFoundError when there is none (the stage is not done), ValueError when it is damaged.
    """
    try:
        content = read_json(folder / MANIFEST)
        seal = content.pop("seal")
        if seal != json_digest(content):
            raise ValueError("the manifest was changed")
        return Manifest.model_validate(content)
    except FileNotFoundError:
        raise
    except FAULTS as error:  # ValidationError is a ValueError
        raise ValueError("the manifest is damaged") from error


def linked_manifest(run: Path, stage: str) -> Manifest | None:
    """The manifest that ``RUN/<stage>`` shows now; None when there is none that can be read."""
    try:
        return read_manifest(run / stage)
    except (OSError, ValueError):
        return None


def hidden_link(run: Path, stage: str) -> Path:
    """The link to the results that ``RUN/<stage>`` showed before the settings or inputs changed."""
    return run / f".{stage}.before"


def last_shown(run: Path, stage: str) -> Manifest | None:
    """The manifest that ``RUN/<stage>`` shows, or showed before the settings or inputs changed."""
    return linked_manifest(run, stage) or linked_manifest(run, hidden_link(run, stage).name)


def published_files(folder: Path) -> dict[str, Path]:
    """Relative POSIX path -> file, for every file that belongs to the outputs in ``folder``."""
    return {
        file.relative_to(folder).as_posix(): file
        for file in sorted(folder.rglob("*"))
        if file.is_file() and not file.is_symlink() and not is_partial(file) and file != folder / MANIFEST
    }


def damages(
    folder: Path, manifest: Manifest, names: Iterable[str], memo: DigestMemo, *, rehash: bool = False
) -> Iterator[str]:
    """What makes the files ``names`` in ``folder`` others than those of ``manifest``.

    Sizes are always read; digests come through ``memo``, and one that differs is computed again first. With
    ``rehash`` each file is read.
    """
    for name in names:
        record, file = manifest.files[name], folder / name
        try:
            if file.stat().st_size != record.size:
                yield f"{name} has another size"
                continue
            if rehash:
                memo.forget(file)
            if memo.digest(file) != record.digest:
                memo.forget(file)
                if memo.digest(file) != record.digest:
                    yield f"{name} has other content"
        except FileNotFoundError:
            yield f"{name} is missing"
        except OSError as error:
            yield f"{name} cannot be read: {error.strerror or error}"


def plain_json(value: Any) -> Any:
    """``value`` as JSON holds it: numpy scalars as numbers, tuples as lists, NaN and infinities as null."""

    def plain(unknown: Any) -> Any:
        return unknown.tolist() if hasattr(unknown, "tolist") else str(unknown)

    return to_jsonable_python(value, inf_nan_mode="null", fallback=plain)
