"""What the user sees while work is under way: bars on a terminal, plain lines elsewhere, always on stderr."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import timedelta
from typing import TYPE_CHECKING, Any

import click

from cleargs.progress import Pace, Reporter, SilentReporter, Task
from cleargs.text import printable

if TYPE_CHECKING:
    from rich.console import Console
    from rich.progress import Progress, TaskID

LINE_EVERY = 10.0
"""Seconds between two lines of one task where there is no terminal."""


def make_reporter(quiet: bool = False) -> Reporter:
    """The reporter that suits stderr; ``quiet`` leaves the warnings only."""
    if quiet:
        return QuietReporter()
    return BarReporter() if sys.stderr.isatty() else LineReporter()


class QuietReporter(SilentReporter):
    """Warnings only."""

    def warn(self, text: str) -> None:
        click.echo(f"warning: {printable(text)}", err=True)


class LineReporter(QuietReporter):
    """Plain lines, as a log wants them."""

    @contextmanager
    def task(self, label: str, total: int | None = None) -> Iterator[Task]:
        begin = time.monotonic()
        label = printable(label)
        line = LineTask(label, total)
        yield line
        note = f", {line.note}" if line.note else ""
        click.echo(f"{label}: done in {time.monotonic() - begin:.1f} s{note}", err=True)

    def info(self, text: str) -> None:
        click.echo(printable(text), err=True)


class LineTask:
    """Counted work that says every few seconds how far it is."""

    def __init__(self, label: str, total: int | None) -> None:
        self.label = label
        self.total = total
        self.done = 0
        self.note = ""
        self._said = time.monotonic()
        self._pace = Pace(total)

    def advance(self, steps: int = 1) -> None:
        self.update(done=self.done + steps)

    def update(self, *, done: int | None = None, note: str | None = None, share: float | None = None) -> None:
        self.done = self.done if done is None else done
        self.note = self.note if note is None else printable(note)
        now, left = time.monotonic(), self._pace.seconds_left(self.done, share)
        if now - self._said >= LINE_EVERY:
            self._said = now
            click.echo(self._text(left), err=True)

    def _text(self, left: float | None) -> str:
        words = [f"{self.label}: {self.done}" + (f"/{self.total}" if self.total else "")]
        if self.note:
            words.append(self.note)
        if left is not None:
            words.append(f"{left:.0f} s left")
        return ", ".join(words)


class BarReporter:
    """Bars with the time left, remarks above them. The display lives as long as the outermost task."""

    def __init__(self) -> None:
        from rich.console import Console

        # Not sys.stderr, which escapes (see `terminal`): bars move the cursor.
        self._console = Console(file=sys.__stderr__)
        self._progress: Progress | None = None

    @contextmanager
    def task(self, label: str, total: int | None = None) -> Iterator[Task]:
        label = printable(label)
        if self._progress is not None:
            bar = self._progress.add_task(label, total=total, left="", note="")
            yield BarTask(self._progress, bar)
            self._progress.stop_task(bar)
            return
        self._progress = _bars(self._console)
        try:
            with self._progress:
                bar = self._progress.add_task(label, total=total, left="", note="")
                yield BarTask(self._progress, bar)
        finally:
            self._progress = None

    def info(self, text: str) -> None:
        self._console.print(printable(text), markup=False, highlight=False)

    def warn(self, text: str) -> None:
        self._console.print(f"warning: {printable(text)}", style="yellow", markup=False, highlight=False)


class BarTask:
    """One bar."""

    def __init__(self, progress: Progress, bar: TaskID) -> None:
        self._progress = progress
        self._bar = bar
        self._task = next(task for task in progress.tasks if task.id == bar)
        self._pace = Pace(None if self._task.total is None else int(self._task.total))

    def advance(self, steps: int = 1) -> None:
        self.update(done=int(self._task.completed) + steps)

    def update(self, *, done: int | None = None, note: str | None = None, share: float | None = None) -> None:
        changes: dict[str, Any] = {}
        if done is not None:
            left = self._pace.seconds_left(done, share)
            changes["completed"] = done
            changes["left"] = f"{_clock(left)} left" if left else ""
        if note is not None:
            changes["note"] = printable(note)
        self._progress.update(self._bar, **changes)


def _clock(seconds: float) -> str:
    """``h:mm:ss``."""
    return str(timedelta(seconds=round(seconds)))


def _bars(console: Console) -> Progress:
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    return Progress(
        TextColumn("{task.description}", markup=False),
        BarColumn(bar_width=24),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("{task.fields[left]}"),
        TextColumn("{task.fields[note]}", markup=False),
        console=console,
    )
