"""What a benchmark found, as plain data."""

from __future__ import annotations

import os
import platform
from dataclasses import asdict, dataclass
from importlib.metadata import version
from typing import Any

import cleargs
from benchmarks.speed.benchmark_plan import BenchmarkCase
from benchmarks.speed.oracle import Accuracy
from benchmarks.speed.peaks import Peaks
from benchmarks.speed.roofline import Roof
from benchmarks.speed.timing import Quartiles
from benchmarks.speed.work import Size
from cleargs.splat.pace import processor_name

Times = dict[str, Quartiles]
"""Part of an iteration -> milliseconds."""


@dataclass(frozen=True)
class Machine:
    """Where it was measured, and what else ran there."""

    processor: str
    cores: int
    versions: dict[str, str]
    load_before: float  # load average over a minute
    load_after: float


@dataclass(frozen=True)
class TorchTimes:
    """The pure-torch rasteriser, forward and backward, by the number of threads."""

    times: dict[int, Quartiles]  # ms
    ratio: dict[int, Quartiles]  # its time / ours, round by round
    accuracy: Accuracy  # behind the oracle's projection


@dataclass(frozen=True)
class Rasterisers:
    """Our rasteriser against pure torch, forward and backward, by the number of threads."""

    ours: dict[int, Quartiles]  # ms
    torch: TorchTimes


@dataclass(frozen=True)
class ResultRow:
    """One case."""

    case: BenchmarkCase
    pairs: int
    contributions: int
    times: dict[int, Times]  # by the number of threads
    memory: int | None  # bytes; None where the system does not tell
    accuracy: Accuracy
    rasterisers: Rasterisers | None  # None: not run


@dataclass(frozen=True)
class ScalingPoint:
    """Forward and backward pass on all threads, and peak memory, at one number of pairs."""

    case: BenchmarkCase
    pairs: int
    milliseconds: Quartiles
    memory: int | None


@dataclass(frozen=True)
class Rooflines:
    """The kernels of one case under the machine's roof, by the number of threads."""

    case: BenchmarkCase
    size: Size
    peaks: dict[int, Peaks]
    kernels: dict[int, list[Roof]]


@dataclass(frozen=True)
class Benchmark:
    """Everything that ``python -m benchmarks splat`` reports."""

    machine: Machine
    threads: tuple[int, ...]
    rows: list[ResultRow]
    roofline: Rooflines | None
    scaling: dict[str, list[ScalingPoint]]  # series -> points

    def as_json(self) -> dict[str, Any]:
        """Plain dictionaries and lists; a BenchmarkCase or a Size becomes an object with named fields."""
        plain: dict[str, Any] = asdict(self, dict_factory=named)
        return plain


def named(items: list[tuple[str, Any]]) -> dict[str, Any]:
    """The fields of a dataclass; a BenchmarkCase or a Size becomes an object with named fields too."""
    return {
        name: value._asdict() if isinstance(value, BenchmarkCase | Size) else value for name, value in items
    }


def describe_machine(load_before: float) -> Machine:
    """This machine, at the end of the measurements."""
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
