"""How long work tells what it is doing, without knowing who listens (a terminal, a log, nobody)."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from functools import partial
from typing import Protocol

from cleargs.safe_io import printable

Say = Callable[[str], object]
"""Is told a line."""

PREVIEW = "preview.png"
"""A picture of the work so far, which a stage may leave among its checkpoints."""


LINE_EVERY = 10.0
"""Seconds between two lines of one task."""


class Task(Protocol):
    """One piece of counted work."""

    def advance(self, steps: int = 1) -> None:
        """``steps`` more are done."""

    def update(self, *, done: int | None = None, note: str | None = None, share: float | None = None) -> None:
        """``done`` in all are done; ``note`` (a few figures, say) is shown beside the bar. ``share`` of the
        work is behind us, where steps differ so much that their number does not say.
        """


class Reporter(Protocol):
    """Where progress and remarks go."""

    def task(self, label: str, total: int | None = None) -> AbstractContextManager[Task]:
        """Open a piece of work of ``total`` steps (None: unknown); it closes with the block."""

    def info(self, text: str) -> None:
        """A remark worth a line."""

    def warn(self, text: str) -> None:
        """Something the user should look at, although the work continues."""


class Rate:
    """Steps a second, of the last seconds: where steps grow longer, the mean of all would flatter."""

    SECONDS = 10.0
    """It is that of one to two times so many seconds, of fewer at the beginning."""

    def __init__(self) -> None:
        self._readings: list[tuple[float, int]] = []
        """Time and steps done: where the rate counts from, then where it will."""

    def per_second(self, done: int) -> float | None:
        """To be asked whenever ``done`` grows; None at first."""
        now = time.monotonic()
        begin = self._readings[0] if self._readings else None
        if begin is None or now - self._readings[-1][0] >= self.SECONDS:
            self._readings = [*self._readings[-1:], (now, done)]
        return (done - begin[1]) / (now - begin[0]) if begin is not None and now > begin[0] else None


Show = Callable[[int, str, float | None], None]
"""Is told of a task: the steps done, the note, and the seconds left."""


class CountedTask:
    """Counted work; each change calls ``show``."""

    def __init__(self, total: int | None, show: Show) -> None:
        self.done, self.note = 0, ""
        self._total, self._show = total, show
        self._first: tuple[float, float] | None = None
        """When the first step was done, and the share of the work that it was. What comes before that step
        (compiling kernels, reading a checkpoint) says nothing of those to come."""

    def advance(self, steps: int = 1) -> None:
        self.update(done=self.done + steps)

    def update(self, *, done: int | None = None, note: str | None = None, share: float | None = None) -> None:
        self.done = self.done if done is None else done
        self.note = self.note if note is None else printable(note)
        self._show(self.done, self.note, self._seconds_left(share))

    def _seconds_left(self, share: float | None) -> float | None:
        """The time that the task will still take by its pace so far; None while that is not known."""
        if not self._total or not self.done:
            return None
        now = time.monotonic()
        share = self.done / self._total if share is None else share
        begin, first = self._first = self._first or (now, share)
        return (now - begin) * max(0.0, 1.0 - share) / (share - first) if share > first else None


class SilentReporter:
    """A reporter nobody listens to."""

    @contextmanager
    def task(self, label: str, total: int | None = None) -> Iterator[Task]:
        yield CountedTask(total, lambda done, note, left: None)

    def info(self, text: str) -> None: ...

    def warn(self, text: str) -> None: ...


class LineReporter:
    """A reporter that passes lines on to functions: remarks, warnings, and how far each task is."""

    def __init__(self, info: Say, warn: Say, progress: Say) -> None:
        self._info, self._warn, self._progress = info, warn, progress

    @contextmanager
    def task(self, label: str, total: int | None = None) -> Iterator[Task]:
        last = begin = time.monotonic()

        def show(done: int, note: str, left: float | None) -> None:
            nonlocal last
            if time.monotonic() - last >= LINE_EVERY:
                last = time.monotonic()
                count = f"{label}: {done}" + (f"/{total}" if total else "")
                rest = "" if left is None else f"{left:.0f} s left"
                self._progress(", ".join(filter(None, (count, note, rest))))

        task = CountedTask(total, show)
        yield task
        note = f", {task.note}" if task.note else ""
        self._progress(f"{label}: done in {time.monotonic() - begin:.1f} s{note}")

    def info(self, text: str) -> None:
        self._info(text)

    def warn(self, text: str) -> None:
        self._warn(text)


def log_reporter() -> LineReporter:
    """The reporter of the library: lines go to the logger ``cleargs``, where a program routes them."""
    logger = logging.getLogger("cleargs")
    return LineReporter(*(partial(log, "%s") for log in (logger.info, logger.warning, logger.debug)))
