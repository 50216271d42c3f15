"""Times on a noisy machine: variants take turns in one process, medians and quartiles are kept.

A load from outside then falls on all variants alike, and the ratio of two is taken within each round.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from statistics import median

import numpy as np
import torch


@dataclass(frozen=True)
class Quartiles:
    """The middle of a few measurements, and how far they scatter."""

    low: float
    median: float
    high: float

    @classmethod
    def of(cls, values: list[float]) -> Quartiles:
        """The quartiles of at least one value, interpolated between neighbours."""
        low, middle, high = np.quantile(np.asarray(values, np.float64), (0.25, 0.5, 0.75)).tolist()
        return cls(low, middle, high)


@dataclass
class Clock:
    """Milliseconds of the named parts of repeated work, by round and repetition.

    A part that runs several times within a repetition counts once, with the sum.
    """

    rounds: list[list[dict[str, float]]] = field(default_factory=lambda: [[]])

    @contextmanager
    def repetition(self) -> Iterator[None]:
        """Everything timed within the block belongs to one repetition of the work."""
        self.rounds[-1].append({})
        yield

    @contextmanager
    def time(self, part: str) -> Iterator[None]:
        """Add the duration of the block to a part of the current repetition."""
        start = time.perf_counter()
        yield
        self.add(part, 1e3 * (time.perf_counter() - start))

    def add(self, part: str, milliseconds: float) -> None:
        """Add to a part of the current repetition."""
        parts = self.rounds[-1][-1]
        parts[part] = parts.get(part, 0.0) + milliseconds

    def settle(self) -> None:
        """Called at the end of a round; nothing is pending on a clock of wall time."""

    def quartiles(self) -> dict[str, Quartiles]:
        """Every part over all repetitions of all rounds."""
        repetitions = [repetition for turn in self.rounds for repetition in turn]
        parts = dict.fromkeys(part for repetition in repetitions for part in repetition)
        return {part: Quartiles.of([r[part] for r in repetitions if part in r]) for part in parts}

    def by_round(self, *parts: str) -> list[float]:
        """The median sum of the parts in each round."""
        return [median(sum(r[part] for part in parts) for r in turn) for turn in self.rounds]


@dataclass
class EventClock(Clock):
    """A GPU's own time between two points of its queue, so that timing makes nobody wait before `settle`."""

    _pending: list[tuple[dict[str, float], str, torch.cuda.Event, torch.cuda.Event]] = field(
        default_factory=list
    )

    @contextmanager
    def time(self, part: str) -> Iterator[None]:
        """Add what the device takes for the work that the block queues."""
        start, end = (
            torch.cuda.Event(enable_timing=True)  # type: ignore[no-untyped-call]  # torch's own
            for _ in range(2)
        )
        start.record()
        yield
        end.record()
        self._pending.append((self.rounds[-1][-1], part, start, end))

    def settle(self) -> None:
        """Wait for the device and note what was timed."""
        torch.cuda.synchronize()
        for parts, part, start, end in self._pending:
            parts[part] = parts.get(part, 0.0) + start.elapsed_time(end)
        self._pending.clear()


def ratio(ours: list[float], theirs: list[float]) -> Quartiles:
    """Quartiles over the rounds of ours / theirs."""
    return Quartiles.of([mine / other for mine, other in zip(ours, theirs, strict=True)])


def take_turns(
    variants: Mapping[str, Callable[[Clock], object]], rounds: int, clock: type[Clock] = Clock
) -> dict[str, Clock]:
    """Run every variant once to warm up, then ``rounds`` times in turn, each round starting with another one.

    A variant times itself on the clock that it is given, one or more repetitions a round.
    """
    for run in variants.values():
        run(clock())
    clocks = {name: clock(rounds=[]) for name in variants}
    names = list(variants)
    for turn in range(rounds):
        first = turn % len(names)
        for name in names[first:] + names[:first]:
            clocks[name].rounds.append([])
            variants[name](clocks[name])
            clocks[name].settle()
    return clocks
