"""Timing on a noisy machine: variants run alternately in one process, and medians and quartiles are reported.

Other load on the machine then affects all variants alike. The ratio of two variants is taken in each round.
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
    """Median and quartiles of some measurements."""

    low: float
    median: float
    high: float

    @classmethod
    def of(cls, values: list[float]) -> Quartiles:
        """Return the quartiles of at least one value, with linear interpolation."""
        low, middle, high = np.quantile(np.asarray(values, np.float64), (0.25, 0.5, 0.75)).tolist()
        return cls(low, middle, high)


@dataclass
class Clock:
    """Wall time in ms of named parts of repeated work, by round and repetition.

    The times of a part within one repetition are added.
    """

    rounds: list[list[dict[str, float]]] = field(default_factory=lambda: [[]])

    @contextmanager
    def repetition(self) -> Iterator[None]:
        """Assign all times within the block to one new repetition."""
        self.rounds[-1].append({})
        yield

    @contextmanager
    def time(self, part: str) -> Iterator[None]:
        """Add the time of the block to ``part`` of the current repetition."""
        start = time.perf_counter()
        yield
        self.add(part, 1e3 * (time.perf_counter() - start))

    def add(self, part: str, milliseconds: float) -> None:
        """Add to ``part`` of the current repetition."""
        parts = self.rounds[-1][-1]
        parts[part] = parts.get(part, 0.0) + milliseconds

    def finish_round(self) -> None:
        """End a round; a subclass may collect pending times here."""

    def quartiles(self) -> dict[str, Quartiles]:
        """Return the quartiles of each part over all repetitions."""
        repetitions = [repetition for turn in self.rounds for repetition in turn]
        parts = dict.fromkeys(part for repetition in repetitions for part in repetition)
        return {part: Quartiles.of([r[part] for r in repetitions if part in r]) for part in parts}

    def by_round(self, *parts: str) -> list[float]:
        """Return the median over repetitions of the sum of ``parts``, per round."""
        return [median(sum(r[part] for part in parts) for r in turn) for turn in self.rounds]


@dataclass
class EventClock(Clock):
    """Time on the GPU between two events of its queue; only `finish_round` waits for the device."""

    _pending: list[tuple[dict[str, float], str, torch.cuda.Event, torch.cuda.Event]] = field(
        default_factory=list
    )

    @contextmanager
    def time(self, part: str) -> Iterator[None]:
        """Add the device time of the work that the block queues."""
        start, end = (
            torch.cuda.Event(enable_timing=True)  # type: ignore[no-untyped-call]  # torch's own
            for _ in range(2)
        )
        start.record()
        yield
        end.record()
        self._pending.append((self.rounds[-1][-1], part, start, end))

    def finish_round(self) -> None:
        """Wait for the device and add the pending times."""
        torch.cuda.synchronize()
        for parts, part, start, end in self._pending:
            parts[part] = parts.get(part, 0.0) + start.elapsed_time(end)
        self._pending.clear()


def ratio(ours: list[float], theirs: list[float]) -> Quartiles:
    """Return the quartiles of the ratio ours / theirs over the rounds."""
    return Quartiles.of([mine / other for mine, other in zip(ours, theirs, strict=True)])


def interleave(
    variants: Mapping[str, Callable[[Clock], object]], rounds: int, clock: type[Clock] = Clock
) -> dict[str, Clock]:
    """Time variants alternately.

    Each variant runs once to warm up, then once per round. The first variant of a round changes.

    Args:
        variants: Name -> function that times one or more repetitions on the clock it receives.
        rounds: Number of rounds.
        clock: Kind of clock.

    Returns:
        The clock of each variant.
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
            clocks[name].finish_round()
    return clocks
