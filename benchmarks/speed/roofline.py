"""Roofline model: time of each kernel relative to the peaks of the machine (Williams et al. 2009)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

from benchmarks.speed.peaks import Peaks
from benchmarks.speed.timing import Quartiles
from benchmarks.speed.work import KernelWork


@dataclass(frozen=True)
class Roof:
    """A kernel and its minimum time: that of its operations or of its bytes at the peak of the machine."""

    kernel: str
    operations: float
    bytes: float
    milliseconds: float
    bound: Literal["operations", "bytes"]
    fraction: float  # minimum time / time; above 1 if caches deliver bytes faster than memory


def roof(kernel: str, work: KernelWork, milliseconds: float, peaks: Peaks) -> Roof:
    """Return the roofline of one kernel."""
    by_operations = work.operations / (peaks.gflops * 1e6)
    by_bytes = work.bytes / (peaks.gbytes * 1e6)
    return Roof(
        kernel=kernel,
        operations=work.operations,
        bytes=work.bytes,
        milliseconds=milliseconds,
        bound="operations" if by_operations >= by_bytes else "bytes",
        fraction=max(by_operations, by_bytes) / milliseconds,
    )


def roofline(work: Mapping[str, KernelWork], times: Mapping[str, Quartiles], peaks: Peaks) -> list[Roof]:
    """Return the rooflines of all kernels for their median times."""
    return [roof(name, work[name], times[name].median, peaks) for name in work]
