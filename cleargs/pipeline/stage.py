"""What a stage is: the contract between the runner and the modules in ``stages/``."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Generic, Literal, Protocol, TypeAlias, TypeVar

from pydantic import BaseModel

from cleargs.files import External
from cleargs.progress import Reporter

Device: TypeAlias = Literal["cpu", "cuda"]

C = TypeVar("C", bound=BaseModel, covariant=True)


@dataclass(frozen=True)
class StageContext(Generic[C]):
    """All that a stage may know about its surroundings."""

    config: C
    """The stage's own section of the run's configuration."""
    source: Path
    """The capture as the user gave it; only ``ingest`` reads it."""
    inputs: Mapping[str, Path]
    """Finished folder of each upstream stage, by name."""
    externals: Mapping[str, External]
    """What the stage's ``externals`` returned: files whose content is part of the key."""
    out: Path
    """Outputs go here. What a killed try of the same key left is still here; files appear atomically."""
    checkpoints: Path
    """In-stage state. Never published, deleted when the stage is done."""
    cache: Path
    """What was found out about single items (frames, say), for any later work of this stage in the store:
    files that appear whole, named by the digest of all that decides them. Any may be missing at any time."""
    seed: int
    device: Device
    threads: int
    reporter: Reporter
    expected: Mapping[str, Estimate] = field(default_factory=dict)
    """When a cost is estimated: what the upstream stages expect that are not in ``inputs`` yet."""
    settings: Mapping[str, Any] = field(default_factory=dict)
    """The sections of the stages that the stage names in ``SETTINGS``."""


@dataclass(frozen=True)
class StageResult:
    """How a stage ended."""

    missing: tuple[str, ...] = ()
    """What could not be made, one line each; not empty means that the stage is done only in part."""
    summary: Mapping[str, Any] = field(default_factory=dict)
    """Figures for ``manifest.json`` and ``cleargs show`` (JSON values; outputs hold no clock times)."""


@dataclass(frozen=True)
class Estimate:
    """What a stage is expected to take, said before work starts."""

    minutes: float
    memory_gb: float
    disk_gb: float
    frames: int = 0
    """Frames that the stage will publish; 0 where it publishes none."""
    megapixels: float = 0.0
    """Of one of them."""

    def at_pace(self, pace: float) -> Estimate:
        """Where all takes ``pace`` times as long."""
        return replace(self, minutes=pace * self.minutes)


class Stage(Protocol):
    """A module in ``stages/``. Its top level imports only its config model: heavy imports live in ``run``,
    so that a run with nothing to do costs no import of torch.
    """

    VERSION: int
    """Raised whenever the stage's source changes its results."""
    CONFIG: type[BaseModel]
    SETTINGS: tuple[str, ...]
    """Upstream stages whose settings hold for this one too; they enter the key."""
    INPUTS: Mapping[str, tuple[str, ...]]
    """Upstream stage -> files and folders in it that this stage reads; their digests enter the key."""
    OUTPUTS: tuple[str, ...]
    """Files and folders that exist when the stage is done."""
    LEFTOVERS: tuple[str, ...]
    """Patterns of the files in ``out`` from which it resumes after a killed try (``*`` within one name).
    Whatever else such a try left there is thrown away."""
    LIBRARIES: tuple[str, ...]
    """Distributions whose version changes results; their versions enter the key. A stage may also have a
    function ``other_libraries(device)``: name -> version of what computes on that device only."""

    def externals(self, config: Any, source: Path) -> Mapping[str, External]:
        """Role -> files outside the store whose content enters the key (capture, model weights)."""

    def preflight(self, config: Any) -> None:
        """Raise InputError when a model or a server that the settings name cannot be had.

        Asked before the first stage of a run starts: hours of work are not to end in a missing file.
        """

    def estimate(self, context: StageContext[Any]) -> Estimate:
        """Rough cost, from the settings and the inputs that already exist."""

    def run(self, context: StageContext[Any]) -> StageResult:
        """Do the work: read ``context.inputs``, write ``OUTPUTS`` into ``context.out``."""
