"""The folder of a batch, and the small files in it by which its jobs, its engine and its watchers speak.

::

    BATCH/store/                       one store, shared by all scenes and nodes
    BATCH/scenes/<scene>/              run folders, as `cleargs run` would make them
    BATCH/handles/<scene>/<stage>.json digests of a finished stage: what Snakemake sees
    BATCH/status/<scene>/<stage>.json  what the stage's job did last
    BATCH/logs/<scene>/<stage>.log     what it said; BATCH/logs/engine.log is Snakemake's
    BATCH/report/index.html            all scenes as a page, which leads to their own reports
    BATCH/plan.json                    what the Snakefile reads; a dry run has dry-run.json
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal, TypeVar

from pydantic import BaseModel

from cleargs.batch.resources import Resources
from cleargs.errors import StoreError
from cleargs.files import write_bytes
from cleargs.manifest import Manifest
from cleargs.record import Record
from cleargs.untrusted import FAULTS, read_json

M = TypeVar("M", bound=BaseModel)

Doing = Literal["running", "done", "partial", "failed", "interrupted", "requeued"]


class Handle(Record):
    """What Snakemake sees of a finished stage. No key and no time: those would make later stages stale."""

    digest: str
    status: Literal["complete", "partial"]


class Status(Record):
    """What the job of one stage did last."""

    state: Doing
    node: str
    job: str = ""
    """Id of the Slurm job; "" outside Slurm."""
    started: float
    """Seconds since 1970."""
    seconds: float = 0.0
    exit_code: int | None = None
    cause: str = ""


class Plan(Record):
    """What the Snakefile is told."""

    watcher: tuple[str, ...]
    """The command that runs one job and notes what becomes of it."""
    program: tuple[str, ...]
    """How ``cleargs`` is called on every node."""
    options: tuple[str, ...]
    """Further options of ``cleargs stage``."""
    stages: dict[str, tuple[str, ...]]
    """Stage -> the stages that it reads, in order. All of them, also behind `until`: jobs of an earlier batch
    may be left on the cluster, and read this when they start."""
    until: str
    """The last stage that is wanted."""
    report: bool = False
    """Whether the job of the last stage also writes the report of its scene."""
    scenes: dict[str, dict[str, Resources]]
    """Scene -> stage -> what the job asks for."""

    @property
    def wanted(self) -> tuple[str, ...]:
        """The stages up to `until`, in order."""
        names = tuple(self.stages)
        return names[: names.index(self.until) + 1]


@dataclass(frozen=True)
class BatchFolder:
    """Where everything of a batch lies."""

    root: Path

    @property
    def store(self) -> Path:
        """The shared store."""
        return self.root / "store"

    def plan(self, *, dry_run: bool = False) -> Path:
        """What the Snakefile reads. A dry run has another: jobs on the cluster may still need this one."""
        return self.root / ("dry-run.json" if dry_run else "plan.json")

    @property
    def engine_log(self) -> Path:
        """What Snakemake said."""
        return self.root / "logs" / "engine.log"

    def run(self, scene: str) -> Path:
        """The run folder of ``scene``."""
        return self.root / "scenes" / scene

    def log(self, scene: str, stage: str) -> Path:
        """What the stage said, all tries."""
        return self.root / "logs" / scene / f"{stage}.log"

    def handle(self, scene: str, stage: str) -> Path:
        """The handle of a finished stage."""
        return self.root / "handles" / scene / f"{stage}.json"

    def write_handle(self, scene: str, stage: str, handle: Handle) -> None:
        """Note that a stage is finished; a handle that says so already is not touched."""
        if self.read_handle(scene, stage) != handle:
            _write(self.handle(scene, stage), handle)

    def refresh(self, scene: str, stage: str, manifest: Manifest | None) -> None:
        """Make the handle say what ``manifest`` says; take it away where there is none."""
        if manifest is None:
            self.handle(scene, stage).unlink(missing_ok=True)
        else:
            self.write_handle(scene, stage, Handle(digest=manifest.digest, status=manifest.status))

    def read_handle(self, scene: str, stage: str) -> Handle | None:
        """The handle; None where the stage is not finished."""
        return _read(self.handle(scene, stage), Handle)

    def write_status(self, scene: str, stage: str, status: Status) -> None:
        """Note what the job of a stage does now."""
        _write(self._status(scene, stage), status)

    def read_status(self, scene: str, stage: str) -> Status | None:
        """What the job of a stage did last; None where none has begun."""
        return _read(self._status(scene, stage), Status)

    def forget_status(self, scene: str, stage: str) -> None:
        """Forget what the job of a stage did last: another is to come."""
        self._status(scene, stage).unlink(missing_ok=True)

    def read_plan(self) -> Plan | None:
        """The plan of the last batch; None where there was none."""
        return _read(self.plan(), Plan)

    def write_plan(self, plan: Plan, *, dry_run: bool = False) -> None:
        """Write what the Snakefile reads."""
        _write(self.plan(dry_run=dry_run), plan)

    def _status(self, scene: str, stage: str) -> Path:
        return self.root / "status" / scene / f"{stage}.json"


def _write(path: Path, model: BaseModel) -> None:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise StoreError(
            f"cannot write to {path.parent}: {error.strerror}", hint="choose another -o"
        ) from error
    write_bytes(path, model.model_dump_json(indent=1).encode())  # in order, which the plan's stages need


def _read(path: Path, kind: type[M]) -> M | None:
    try:
        return kind.model_validate(read_json(path))
    except FAULTS:  # ValidationError is a ValueError
        return None
