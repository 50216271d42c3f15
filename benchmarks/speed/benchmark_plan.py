"""Plans of benchmarks: sizes, threads and repetitions."""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

MEDIAN_SIGMA = 1.8
"""Median standard deviation of the projected splats, px: a splat then touches about five tiles."""


class BenchmarkCase(NamedTuple):
    """A random scene and the size of its view."""

    gaussians: int
    width: int  # px
    height: int  # px
    sigma: float = MEDIAN_SIGMA  # px

    @property
    def title(self) -> str:
        """Name in tables."""
        return f"{self.gaussians:,} at {self.width}x{self.height}"


@dataclasses.dataclass(frozen=True)
class Plan:
    """A benchmark of the CPU. Each case is timed alternately on each number of threads."""

    cases: tuple[BenchmarkCase, ...]
    threads: tuple[int, ...]
    rounds: int = 7
    repetitions: int = 3  # iterations per round
    torch_rounds: int = 3  # rounds of the comparison with torch, one iteration per round
    torch_largest: BenchmarkCase | None = None  # pure torch runs up to this many splats and pixels
    roofline: BenchmarkCase | None = None
    more_splats: tuple[BenchmarkCase, ...] = ()  # scaling: the number of splats grows
    larger_splats: tuple[BenchmarkCase, ...] = ()  # scaling: each splat grows
    memory: bool = True
    peak_repeats: int = 50
    seed: int = 0

    def compares_torch(self, case: BenchmarkCase) -> bool:
        """Return True if the pure-torch rasteriser runs on this case too."""
        largest = self.torch_largest
        return (
            largest is not None
            and case.gaussians <= largest.gaussians
            and case.width * case.height <= largest.width * largest.height
        )


@dataclasses.dataclass(frozen=True)
class DevicePlan:
    """A benchmark of a GPU."""

    cases: tuple[BenchmarkCase, ...]
    rounds: int = 7
    repetitions: int = 10  # iterations per round
    seed: int = 0


def device_plan() -> DevicePlan:
    """Return the plan with 100,000 to 3,000,000 splats at 1280x720 and 1920x1080."""
    counts = (100_000, 500_000, 1_000_000, 3_000_000)
    sizes = ((1280, 720), (1920, 1080))
    return DevicePlan(tuple(BenchmarkCase(count, *size) for size in sizes for count in counts))


def quick_device_plan() -> DevicePlan:
    """Return a plan with two small cases, to try the command; do not quote its figures."""
    return DevicePlan(
        (BenchmarkCase(4_000, 160, 90), BenchmarkCase(20_000, 320, 180)), rounds=3, repetitions=3
    )


def full_plan(threads: tuple[int, ...]) -> Plan:
    """Return the plan with 10,000 to 400,000 splats at 320x180 to 1280x720."""
    counts = (10_000, 50_000, 200_000, 400_000)
    sizes = ((320, 180), (640, 360), (960, 540), (1280, 720))
    return Plan(
        cases=tuple(BenchmarkCase(count, *size) for size in sizes for count in counts),
        threads=threads,
        torch_largest=BenchmarkCase(50_000, 960, 540),
        roofline=BenchmarkCase(50_000, 960, 540),
        more_splats=tuple(
            BenchmarkCase(count, 640, 360) for count in (10_000, 20_000, 50_000, 100_000, 200_000, 400_000)
        ),
        larger_splats=tuple(
            BenchmarkCase(50_000, 640, 360, MEDIAN_SIGMA * factor) for factor in (0.5, 1, 2, 4, 8)
        ),
    )


def quick_plan(threads: tuple[int, ...]) -> Plan:
    """Return a plan with the same tables in seconds, to try the command; do not quote its figures."""
    return Plan(
        cases=(BenchmarkCase(1_000, 160, 90), BenchmarkCase(4_000, 160, 90), BenchmarkCase(4_000, 320, 180)),
        threads=threads,
        rounds=3,
        repetitions=2,
        torch_rounds=2,
        torch_largest=BenchmarkCase(4_000, 160, 90),
        roofline=BenchmarkCase(4_000, 320, 180),
        more_splats=tuple(BenchmarkCase(count, 160, 90) for count in (1_000, 2_000, 4_000)),
        larger_splats=tuple(BenchmarkCase(1_000, 160, 90, MEDIAN_SIGMA * factor) for factor in (1, 2, 4)),
        peak_repeats=5,
    )
