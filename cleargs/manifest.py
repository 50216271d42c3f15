"""``manifest.json``: the last file that is written into a stage folder, which marks it as finished."""

from __future__ import annotations

import platform
import re
from collections.abc import Iterable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, ValidationError
from pydantic_core import to_jsonable_python

import cleargs
from cleargs.base_model import FrozenModel
from cleargs.digest import DigestMemo, json_digest
from cleargs.errors import StoreError
from cleargs.files import is_partial, write_json
from cleargs.own_files import has_only_files, regular_files
from cleargs.safe_io import FAULTS, read_json
from cleargs.timing import PartTime

MANIFEST = "manifest.json"

_BEFORE = ".before"
"""Ending of the hidden links of a run."""

SCHEMA = 1
"""Incremented when the computation of keys changes: every old result becomes out of date."""

PRECISION = "float32"
"""Number format of the parameters that the stages train and publish."""


class KeyParts(FrozenModel):
    """Everything that the key of a stage depends on."""

    stage: str
    version: int
    config: dict[str, Any]
    """The stage's section of the settings, without the fields that `key_config` leaves out."""
    inputs: dict[str, dict[str, str | None]]
    """Upstream stage -> declared path -> digest of its content; None if an optional path is absent."""
    externals: dict[str, str]
    """Role -> digest of the content of a file or folder outside the store."""
    seed: int
    device: Literal["cpu", "cuda"]
    libraries: dict[str, str]
    precision: str = PRECISION
    schema_version: int = SCHEMA

    @property
    def key(self) -> str:
        """SHA-256 of the canonical JSON, in hexadecimal."""
        return json_digest(self.model_dump(mode="json"))


class FileRecord(FrozenModel):
    """One published file."""

    size: int
    digest: str


class Manifest(FrozenModel):
    """Contents and origin of a finished stage folder, without host names and absolute paths."""

    stage: str
    key: str
    status: Literal["complete", "partial"]
    """`partial` if this stage or an earlier one is incomplete."""
    missing: tuple[str, ...]
    """Results that this stage could not make, one line each."""
    inherited: tuple[str, ...]
    """Results that earlier stages could not make, as "STAGE: what"."""
    parts: KeyParts
    """Everything that the key depends on."""
    origins: dict[str, dict[str, str]]
    """"STAGE/PATH" (inputs) or role (externals) -> digest of each file in it."""
    files: dict[str, FileRecord]
    """Relative path -> size and digest of every file except the manifest."""
    columns: dict[str, dict[str, str]] = Field(default_factory=dict)
    """Relative path of a table -> column -> meaning. Most readers drop the meanings in the Parquet files."""
    digest: str
    """Digest of all files together (`tree_digest`)."""
    versions: dict[str, str]
    started: str
    """Start time in UTC, ISO 8601."""
    seconds: float
    compile_seconds: float = 0.0
    """Time spent on compiling kernels, which a machine does once. It is not part of ``seconds``."""
    cpu_seconds: float | None = None
    """CPU time of all threads and child processes; None in manifests of earlier versions."""
    peak_memory_gb: float | None = None
    """Peak resident memory of the process while the stage ran, GB (1e9 bytes)."""
    timing: tuple[PartTime, ...] = ()
    """Times of the parts of the last attempt (`cleargs.timing`), each part before its own parts."""
    device: str
    summary: dict[str, Any]
    """The figures that the stage reports."""

    @property
    def bytes(self) -> int:
        """Total size of all files."""
        return sum(record.size for record in self.files.values())

    def under(self, path: str) -> dict[str, str]:
        """Return the digests of the file or folder ``path``: name in the folder ("" for a file) -> digest."""
        if path in self.files:
            return {"": self.files[path].digest}
        prefix = path.rstrip("/") + "/"
        return {
            name.removeprefix(prefix): record.digest
            for name, record in self.files.items()
            if name.startswith(prefix)
        }


def versions() -> dict[str, str]:
    """Return what a manifest stores in addition to the versions of the libraries in the key.

    The processor is not in the key, so that machines of several kinds can continue each other's runs.
    """
    version, python = cleargs.__version__, platform.python_version()
    return {"cleargs": version, "python": python, "processor": instruction_set()}


def instruction_set(cpuinfo: Path = Path("/proc/cpuinfo")) -> str:
    """Return the level of this machine's x86-64 processor (x86-64-v1 to v4), or the name of another kind."""
    machine = platform.machine()
    with suppress(OSError):
        if machine == "x86_64" and (found := re.search(r"^flags\s*:(.*)", cpuinfo.read_text(), re.MULTILINE)):
            added = ("sse4_2", "avx2", "avx512bw")  # by levels 2 to 4
            return f"{machine}-v{1 + sum(name in found[1].split() for name in added)}".replace("_", "-")
    return machine


def write_manifest(folder: Path, manifest: Manifest) -> None:
    """Write ``manifest`` into ``folder`` atomically, with a digest of its content as a seal."""
    content = manifest.model_dump(mode="json")
    write_json(folder / MANIFEST, {**content, "seal": json_digest(content)})


def read_manifest(folder: Path) -> Manifest:
    """Read and check the manifest in ``folder``.

    Raises FileNotFoundError if there is none (the stage is not finished), and ValueError if it is damaged.
    """
    try:
        content = read_json(folder / MANIFEST, root=folder)
        seal = content.pop("seal")
        if seal != json_digest(content):
            raise ValueError("the manifest was changed")
        manifest = Manifest.model_validate(content)
        if any(name.startswith("/") or ".." in name.split("/") for name in manifest.files):
            raise ValueError("a file is outside the folder")
        return manifest
    except FileNotFoundError:
        raise
    except FAULTS as error:  # ValidationError is a ValueError
        raise ValueError("the manifest is damaged") from error


def linked_manifest(run: Path, stage: str) -> Manifest | None:
    """Return the manifest in ``RUN/<stage>``; None if it is missing or cannot be read (`has_results`)."""
    try:
        return read_manifest(run / stage) if has_results(run, stage) else None
    except (OSError, ValueError):
        return None


def has_results(run: Path, stage: str) -> bool:
    """Return True if ``RUN/<stage>`` is a folder of files, or a link to one that the store made.

    A folder with a link, FIFO or device in it has no results.
    """
    folder = results_folder(run, stage)
    return folder is not None and has_only_files(folder)


def results_folder(run: Path, stage: str) -> Path | None:
    """Return the folder ``RUN/<stage>``, or the one to which the store linked it; None for another link.

    The store's link leads to ``<stage>/<key>``, and no folder of the store or of the run on its way is a
    link. The folder need not exist.
    """
    folder = run / stage
    if folder.is_symlink():
        target, name = folder.readlink(), stage.removeprefix(".").removesuffix(_BEFORE)
        folder = run / target
        way = [folder.parent, *(place for place in folder.parents if run in place.parents)]
        if not re.fullmatch(rf".+/{re.escape(name)}/[0-9a-f]{{64}}", target.as_posix()):
            return None
        if ".." in target.parts or any(map(Path.is_symlink, way)):
            return None
    return folder


def hidden_link(run: Path, stage: str) -> Path:
    """Return the path of the link to the results that ``stage`` had before its settings or inputs changed."""
    return run / f".{stage}{_BEFORE}"


def last_shown(run: Path, stage: str) -> Manifest | None:
    """Return the manifest in ``RUN/<stage>``, or the one from before the settings or inputs changed."""
    return linked_manifest(run, stage) or linked_manifest(run, hidden_link(run, stage).name)


def published_files(folder: Path) -> dict[str, Path]:
    """Return relative POSIX path -> file, for every output file in ``folder``."""
    return {
        file.relative_to(folder).as_posix(): file
        for file in regular_files(folder)
        if not is_partial(file) and file != folder / MANIFEST
    }


def damages(
    folder: Path, manifest: Manifest, names: Iterable[str], memo: DigestMemo, *, rehash: bool = False
) -> Iterator[str]:
    """Yield one message per file in ``names`` (relative paths) that differs from its record in ``manifest``.

    A digest of ``memo`` that differs is computed again before it is reported. With ``rehash`` every file is
    read.
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


class Summary(BaseModel):
    """Figures of a stage, which writes those that it sets. A manifest of an older version may have fewer."""

    model_config = ConfigDict(frozen=True, extra="ignore")

    @classmethod
    def of(cls, manifest: Manifest | None) -> Self:
        """Return the figures in a manifest; None for all without one. Raises StoreError if one is damaged."""
        try:
            return cls.model_validate({} if manifest is None else manifest.summary)
        except ValidationError as error:
            first = error.errors(include_url=False)[0]
            raise StoreError(
                f"a figure in the manifest cannot be read: {'.'.join(map(str, first['loc']))}",
                hint="run the stage again with --force",
            ) from error

    def figures(self) -> dict[str, Any]:
        """Return name -> value of the figures that are set."""
        return self.model_dump(exclude_unset=True)


def plain_json(value: Any) -> Any:
    """Convert ``value`` to JSON: numpy scalars to numbers, tuples to lists, NaN and infinity to None."""

    def plain(unknown: Any) -> Any:
        return unknown.tolist() if hasattr(unknown, "tolist") else str(unknown)

    return to_jsonable_python(value, inf_nan_mode="null", fallback=plain)
