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
from typing import Self

from cleargs.base_model import FrozenModel


class PartTime(FrozenModel):
    """Time of a part of a stage, with its own parts."""

    part: tuple[str, ...]
    """Name of the part, after those of the parts that hold it."""
    seconds: float
    cpu_seconds: float
    """Processor time of all threads and of child processes that ended."""
    times: int
    """Number of times that the part was done."""


@dataclass
class _Part:
    seconds: float = 0.0
    cpu_seconds: float = 0.0
    times: int = 0
    parts: dict[str, _Part] = field(default_factory=dict)

    def rows(self, path: tuple[str, ...] = ()) -> Iterator[PartTime]:
        for name, part in self.parts.items():
            here = (*path, name)
            seconds, cpu = round(part.seconds, 3), round(part.cpu_seconds, 3)
            yield PartTime(part=here, seconds=seconds, cpu_seconds=cpu, times=part.times)
            yield from part.rows(here)


_current: ContextVar[_Part | None] = ContextVar("part", default=None)


class timed:  # noqa: N801  # a context manager
    """Count the time of a block as that of the part ``name`` of the block around it.

    It takes a few microseconds: the parts are those of a step, not of a pixel.
    """

    def __init__(self, name: str) -> None:
        self._name = name

    def __enter__(self) -> Self:
        self._around = _current.get()
        if self._around is not None:
            self._part = self._around.parts.setdefault(self._name, _Part())
            _current.set(self._part)
            self._begun, self._cpu = time.perf_counter(), cpu_seconds()
        return self

    def __exit__(self, *_: object) -> None:
        if self._around is not None:
            self._part.seconds += time.perf_counter() - self._begun
            self._part.cpu_seconds += cpu_seconds() - self._cpu
            self._part.times += 1
            _current.set(self._around)


class Record:
    """The times of one recording."""

    def __init__(self) -> None:
        self._root = _Part()

    def rows(self) -> tuple[PartTime, ...]:
        """Return the times so far; each part comes before its own parts."""
        return tuple(self._root.rows())


@contextmanager
def recorded() -> Iterator[Record]:
    """Record the times of this thread's parts until the block ends."""
    record = Record()
    token = _current.set(record._root)
    try:
        yield record
    finally:
        _current.reset(token)


def cpu_seconds() -> float:
    """Return the processor time of this process and of its ended children, s."""
    children = resource.getrusage(resource.RUSAGE_CHILDREN)
    return time.process_time() + children.ru_utime + children.ru_stime
