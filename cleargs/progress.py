"""Progress and remarks of long work, for any receiver: a terminal, a log or none."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from functools import partial
from typing import Protocol

from cleargs.safe_io import printable

Say = Callable[[str], object]
"""A function that receives a line."""

PREVIEW = "preview.png"
"""File with a picture of the work so far, which a stage may store in its checkpoint folder."""


LINE_EVERY = 10.0
"""Seconds between two lines of one task."""


class Task(Protocol):
    """A piece of work whose steps are counted."""

    def advance(self, steps: int = 1) -> None:
        """Report that ``steps`` more steps are done."""

    def update(self, *, done: int | None = None, note: str | None = None, share: float | None = None) -> None:
        """Report the steps done, and a short note to show next to the progress bar, such as a few figures.

        ``share`` is the share of the work that is done, if it differs much from the share of the steps.
        """


class Reporter(Protocol):
    """Receiver of progress and remarks."""

    def task(self, label: str, total: int | None = None) -> AbstractContextManager[Task]:
        """Open a task of ``total`` steps (None: unknown), which closes at the end of the block."""

    def info(self, text: str) -> None:
        """Report a remark of one line."""

    def warn(self, text: str) -> None:
        """Report something that the user should check, although the work continues."""


COMPILING = "compiling kernels, once on this machine"
"""Label of a task that a machine does once. Its time is not part of the time of a stage."""


class Rate:
    """Steps per second over the last seconds only, because steps of a training become slower."""

    SECONDS = 10.0
    """Averaging window: one to two times this many seconds, less at the beginning."""

    def __init__(self, part: float = 0.0, least: float = 0.0) -> None:
        """Make the window at least ``part`` of the time since the first call, and wait ``least`` seconds."""
        self._part, self._least = part, least
        self._readings: list[tuple[float, float]] = []
        """Up to two pairs of time and steps done: the start of the present window and of the next one."""
        self._first: float | None = None

    def per_second(self, done: float) -> float | None:
        """Return the rate; None at first. Call this each time ``done`` grows."""
        now = time.monotonic()
        self._first = now if self._first is None else self._first
        elapsed = now - self._first
        begin = self._readings[0] if self._readings else None
        window = max(self.SECONDS, self._part * elapsed)
        if begin is None or now - self._readings[-1][0] >= window:
            self._readings = [*self._readings[-1:], (now, done)]
        if begin is None or now <= begin[0] or elapsed < self._least:
            return None
        return (done - begin[1]) / (now - begin[0])


Show = Callable[[int, str, float | None], None]
"""A function that receives the state of a task: the steps done, the note, and the seconds left."""


class CountedTask:
    """A task that calls ``show`` after each change."""

    LEAST = 1.0
    """Seconds of work before the first estimate: steps that are reported together have no rate."""

    def __init__(self, total: int | None, show: Show) -> None:
        self.done, self.note = 0, ""
        self._total, self._show = total, show
        self._rate = Rate(part=0.1, least=self.LEAST)
        """Share of the work per second, from the first step on: work before it, such as compiling kernels or
        reading a checkpoint, does not count."""

    def advance(self, steps: int = 1) -> None:
        self.update(done=self.done + steps)

    def update(self, *, done: int | None = None, note: str | None = None, share: float | None = None) -> None:
        self.done = self.done if done is None else done
        self.note = self.note if note is None else printable(note)
        self._show(self.done, self.note, self._seconds_left(share))

    def _seconds_left(self, share: float | None) -> float | None:
        """Return the estimated remaining time of the task; None while it is unknown."""
        if not self._total or not self.done:
            return None
        share = self.done / self._total if share is None else share
        speed = self._rate.per_second(share)
        return max(0.0, 1.0 - share) / speed if speed else None


class BothTasks(CountedTask):
    """A task that forwards to two others, which so have the same estimate of the remaining time."""

    def __init__(self, *tasks: Task) -> None:
        super().__init__(None, lambda done, note, left: None)
        self._tasks = tasks

    def update(self, *, done: int | None = None, note: str | None = None, share: float | None = None) -> None:
        super().update(done=done, note=note)
        for task in self._tasks:
            task.update(done=done, note=note, share=share)


class SilentReporter:
    """A reporter that discards everything."""

    @contextmanager
    def task(self, label: str, total: int | None = None) -> Iterator[Task]:
        yield CountedTask(total, lambda done, note, left: None)

    def info(self, text: str) -> None: ...

    def warn(self, text: str) -> None: ...


class WarningsOnly(SilentReporter):
    """A reporter that passes on warnings alone."""

    def __init__(self, reporter: Reporter) -> None:
        self._reporter = reporter

    def warn(self, text: str) -> None:
        self._reporter.warn(text)


@contextmanager
def repeated(act: Callable[[], None], seconds: float) -> Iterator[None]:
    """Call ``act`` in a thread every ``seconds`` until the block ends."""
    ended = threading.Event()

    def loop() -> None:
        while not ended.wait(seconds):
            act()

    thread = threading.Thread(target=loop, daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


class LineReporter:
    """A reporter that passes lines to functions: remarks, warnings, and the progress of each task."""

    def __init__(self, info: Say, warn: Say, progress: Say) -> None:
        self._info, self._warn, self._progress = info, warn, progress
        self._open: list[str] = []
        """Labels of the tasks that are open, the innermost last."""

    @contextmanager
    def task(self, label: str, total: int | None = None) -> Iterator[Task]:
        last = begin = time.monotonic()
        end: float | None = None
        """Expected end of the task, by the clock of `last`."""
        if total is None:  # there may be no other line until the end
            self._progress(f"{label}: started")

        def line() -> None:
            nonlocal last
            last = time.monotonic()
            count = (
                f"{label}: {task.done}/{total}" if total else f"{label}: {task.done or ''}".removesuffix(": ")
            )
            rest = (
                f"{end - last:.0f} s left" if end is not None and end >= last else f"for {last - begin:.0f} s"
            )
            self._progress(", ".join(filter(None, (count, task.note, rest))))

        def show(done: int, note: str, left: float | None) -> None:
            nonlocal end
            now = time.monotonic()
            end = None if left is None else now + left
            if now - last >= LINE_EVERY:
                line()

        def still_there() -> None:
            if time.monotonic() - last >= 0.8 * LINE_EVERY and self._open[-1:] == [label]:
                line()

        task = CountedTask(total, show)
        self._open.append(label)
        try:
            with repeated(still_there, 0.2 * LINE_EVERY):
                yield task
        finally:
            self._open.remove(label)
        note = f", {task.note}" if task.note else ""
        self._progress(f"{label}: done in {time.monotonic() - begin:.1f} s{note}")

    def info(self, text: str) -> None:
        self._info(text)

    def warn(self, text: str) -> None:
        self._warn(text)


def log_reporter() -> LineReporter:
    """Return a reporter that writes to the logger ``cleargs``, the default of the Python API."""
    logger = logging.getLogger("cleargs")
    return LineReporter(*(partial(log, "%s") for log in (logger.info, logger.warning, logger.debug)))


Progress = Reporter | Say | None
"""Receiver of progress and remarks: the logger ``cleargs`` (None), a function that receives lines, or a
`cleargs.progress.Reporter`."""


def reporter_of(progress: Progress) -> Reporter:
    if progress is None:
        return log_reporter()
    if callable(progress):
        return LineReporter(progress, lambda text: progress(f"warning: {text}"), progress)
    return progress
