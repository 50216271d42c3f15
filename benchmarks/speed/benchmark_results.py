"""Results of a benchmark."""

from __future__ import annotations

import os
import platform
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import cleargs
from benchmarks.speed.benchmark_plan import BenchmarkCase
from benchmarks.speed.oracle import Accuracy
from benchmarks.speed.peaks import Peaks
from benchmarks.speed.roofline import Roof
from benchmarks.speed.timing import Quartiles
from benchmarks.speed.work import Size

Times = dict[str, Quartiles]
"""Part of an iteration -> time in ms."""


@dataclass(frozen=True)
class Machine:
    """The machine and its load during a benchmark."""

    processor: str
    cores: int
    versions: dict[str, str]
    load_before: float  # mean load over one minute
    load_after: float


@dataclass(frozen=True)
class TorchTimes:
    """Forward and backward pass of the pure-torch rasteriser, by number of threads."""

    times: dict[int, Quartiles]  # ms
    ratio: dict[int, Quartiles]  # its time / ours, per round
    accuracy: Accuracy  # after the oracle's projection


@dataclass(frozen=True)
class Rasterisers:
    """Forward and backward pass of our rasteriser and of pure torch, by number of threads."""

    ours: dict[int, Quartiles]  # ms
    torch: TorchTimes


@dataclass(frozen=True)
class ResultRow:
    """Results of one case."""

    case: BenchmarkCase
    pairs: int  # (tile, splat)
    contributions: int
    times: dict[int, Times]  # by number of threads
    memory: int | None  # peak, bytes; None if unknown
    accuracy: Accuracy
    rasterisers: Rasterisers | None  # None if not run


@dataclass(frozen=True)
class ScalingPoint:
    """Time of forward and backward pass on all threads, and peak memory, for one number of pairs."""

    case: BenchmarkCase
    pairs: int
    milliseconds: Quartiles
    memory: int | None  # bytes


@dataclass(frozen=True)
class Rooflines:
    """Rooflines of the kernels for one case, by number of threads."""

    case: BenchmarkCase
    size: Size
    peaks: dict[int, Peaks]
    kernels: dict[int, list[Roof]]


@dataclass(frozen=True)
class Benchmark:
    """Results of ``python -m benchmarks splat``."""

    machine: Machine
    threads: tuple[int, ...]
    rows: list[ResultRow]
    roofline: Rooflines | None
    scaling: dict[str, list[ScalingPoint]]  # series -> points

    def as_json(self) -> dict[str, Any]:
        """Return dictionaries and lists; a BenchmarkCase or Size becomes a dictionary too."""
        plain: dict[str, Any] = asdict(self, dict_factory=named)
        return plain


def named(items: list[tuple[str, Any]]) -> dict[str, Any]:
    """Return the fields of a dataclass; a BenchmarkCase or Size becomes a dictionary too."""
    return {
        name: value._asdict() if isinstance(value, BenchmarkCase | Size) else value for name, value in items
    }


def describe_machine(load_before: float) -> Machine:
    """Describe this machine at the end of the measurements."""
    return Machine(
        processor=processor_name(),
        cores=len(os.sched_getaffinity(0)),
        versions={
            "cleargs": cleargs.__version__,
            "python": platform.python_version(),
            **{name: version(name) for name in ("torch", "numba", "numpy")},
        },
        load_before=load_before,
        load_after=os.getloadavg()[0],
    )


def processor_name() -> str:
    """Return the model name of the processor on Linux, or the architecture on other systems."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.machine()
