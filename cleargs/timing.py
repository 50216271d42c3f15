"""Time of a stage by named parts of the work, which may have parts themselves.

`timed` names a part. Outside `recorded`, and in other threads, it does nothing.
"""

from __future__ import annotations

import resource
import time
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field

from cleargs.base_model import FrozenModel


class PartTime(FrozenModel):
    """Time of a part of a stage, with its own parts."""

    part: tuple[str, ...]
    """Name of the part, after those of the parts that hold it."""
    seconds: float
    cpu_seconds: float
    """Processor time of all threads and of child processes."""
    times: int
    """Number of times that the part was done."""


@dataclass
class Part:
    """A part of the work, with the parts in it by name."""

    seconds: float = 0.0
    cpu_seconds: float = 0.0
    times: int = 0
    parts: dict[str, Part] = field(default_factory=dict)

    def rows(self, path: tuple[str, ...] = ()) -> Iterator[PartTime]:
        """Yield the times of all parts in it, each before its own parts."""
        for name, part in self.parts.items():
            here = (*path, name)
            seconds, cpu = round(part.seconds, 3), round(part.cpu_seconds, 3)
            yield PartTime(part=here, seconds=seconds, cpu_seconds=cpu, times=part.times)
            yield from part.rows(here)


_current: ContextVar[Part | None] = ContextVar("part", default=None)


@contextmanager
def timed(name: str) -> Iterator[None]:
    """Count the time of a block as that of the part ``name`` of the block around it.

    It takes a few microseconds: the parts are those of a step, not of a pixel.
    """
    around = _current.get()
    if around is None:
        yield
        return
    part = around.parts.setdefault(name, Part())
    _current.set(part)
    begun, cpu = time.perf_counter(), cpu_seconds()
    try:
        yield
    finally:
        part.seconds += time.perf_counter() - begun
        part.cpu_seconds += cpu_seconds() - cpu
        part.times += 1
        _current.set(around)


@contextmanager
def recorded() -> Iterator[Part]:
    """Record the times of this thread's parts until the block ends."""
    whole = Part()
    token = _current.set(whole)
    try:
        yield whole
    finally:
        _current.reset(token)


_running = 0.0
"""Processor time of the child process that runs, by its last report, s."""


def child_used(seconds: float) -> None:
    """Count the processor time, s, that a running child process reports; 0 once it has ended."""
    global _running
    _running = seconds


def cpu_seconds() -> float:
    """Return the processor time of this process and of its children, s."""
    ended = resource.getrusage(resource.RUSAGE_CHILDREN)
    return time.process_time() + ended.ru_utime + ended.ru_stime + _running
