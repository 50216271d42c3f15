"""The interface between the runner and the modules in ``stages/``."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar

from pydantic import BaseModel

from cleargs.files import External
from cleargs.progress import Reporter
from cleargs.types import Device

C = TypeVar("C", bound=BaseModel, covariant=True)


@dataclass(frozen=True)
class StageContext(Generic[C]):
    """Everything that the runner passes to a stage."""

    config: C
    """The settings of this stage."""
    source: Path
    """Path of the capture, as given by the user. Only ``ingest`` reads it."""
    inputs: Mapping[str, Path]
    """Finished folder of each upstream stage, by name."""
    externals: Mapping[str, External]
    """Result of `Stage.externals`: files outside the store whose content is part of the key."""
    out: Path
    """Folder for the outputs. It still holds the files of a killed attempt at the same key, so files must be
    written atomically.
    """
    checkpoints: Path
    """Folder for intermediate state. It is never published, and deleted when the stage is done."""
    cache: Path
    """Folder for results per item (for example per frame), for all later runs of this stage in the store.
    A file is written atomically and named by the digest of everything that decides its content. Any file may
    be deleted at any time.
    """
    seed: int
    device: Device
    threads: int
    reporter: Reporter
    expected: Mapping[str, Estimate] = field(default_factory=dict)
    """Only for `Stage.estimate`: estimates of the upstream stages that are not in ``inputs`` yet."""
    settings: Mapping[str, Any] = field(default_factory=dict)
    """Settings of the upstream stages that are listed in `Stage.SETTINGS`, by stage."""


@dataclass(frozen=True)
class StageResult:
    """Result of `Stage.run`."""

    missing: tuple[str, ...] = ()
    """Outputs that could not be made, one line each. If there are any, the stage is done only in part."""
    summary: Mapping[str, Any] = field(default_factory=dict)
    """Figures for ``manifest.json`` and ``cleargs show``: JSON values, without clock times."""


@dataclass(frozen=True)
class Estimate:
    """Expected cost of a stage."""

    minutes: float
    memory_gb: float
    disk_gb: float
    frames: int = 0
    """Number of frames that the stage will publish; 0 if it publishes none."""
    megapixels: float = 0.0
    """Size of one of these frames."""

    def at_pace(self, pace: float) -> Estimate:
        """Return the estimate for a machine that takes ``pace`` times as long."""
        return replace(self, minutes=pace * self.minutes)


class Stage(Protocol):
    """A module in ``stages/``.

    At its top level it imports only its config model. Heavy imports are inside ``run``, so that a run with
    nothing to do does not import torch.
    """

    VERSION: int
    """Number to increase with every change of the source that changes results."""
    CONFIG: type[BaseModel]
    SETTINGS: tuple[str, ...]
    """Upstream stages whose settings this stage also uses. They are part of the key."""
    INPUTS: Mapping[str, tuple[str, ...]]
    """Upstream stage -> its files and folders that this stage reads. Their digests are part of the key."""
    OUTPUTS: tuple[str, ...]
    """Files and folders that the stage writes."""
    LEFTOVERS: tuple[str, ...]
    """Glob patterns of the files in ``out`` from which the stage resumes after a killed attempt. All other
    files of that attempt are deleted.
    """
    LIBRARIES: tuple[str, ...]
    """Distributions that affect the results. Their versions are part of the key.

    A stage may also have a function ``other_libraries(device, config)``, which returns versions of libraries
    used only on this device or with these settings, and a function ``idle(sections)``, which is True if the
    settings leave it nothing to do.
    """

    def externals(self, config: Any, source: Path) -> Mapping[str, External]:
        """Return role -> files outside the store whose content is part of the key (e.g. models)."""

    def preflight(self, config: Any) -> None:
        """Raise InputError if a model or a server that the settings name is unavailable.

        The runner calls this for all stages before it starts the first: hours of work should not end in a
        missing file.
        """

    def estimate(self, context: StageContext[Any]) -> Estimate:
        """Estimate the cost from the settings and from the inputs that already exist."""

    def run(self, context: StageContext[Any]) -> StageResult:
        """Read ``context.inputs`` and write ``OUTPUTS`` into ``context.out``."""
