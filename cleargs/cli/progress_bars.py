"""Progress on stderr: bars on a terminal, plain lines elsewhere."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import timedelta
from typing import TYPE_CHECKING

import click

from cleargs.progress import CountedTask, Reporter, SilentReporter, Task
from cleargs.safe_io import printable

if TYPE_CHECKING:
    from rich.progress import Progress

LINE_EVERY = 10.0
"""Seconds between two lines of one task where there is no terminal."""


def make_reporter(quiet: bool = False) -> Reporter:
    """The reporter that suits stderr; ``quiet`` leaves the warnings only."""
    if quiet:
        return QuietReporter()
    return BarReporter() if sys.stderr.isatty() else PlainTextReporter()


class QuietReporter(SilentReporter):
    """Warnings only."""

    def warn(self, text: str) -> None:
        click.echo(f"warning: {printable(text)}", err=True)


class PlainTextReporter(QuietReporter):
    """Plain lines for a log."""

    @contextmanager
    def task(self, label: str, total: int | None = None) -> Iterator[Task]:
        label, begin = printable(label), time.monotonic()
        last = begin

        def show(done: int, note: str, left: float | None) -> None:
            nonlocal last
            if time.monotonic() - last >= LINE_EVERY:
                last = time.monotonic()
                count = f"{label}: {done}" + (f"/{total}" if total else "")
                rest = "" if left is None else f"{left:.0f} s left"
                click.echo(", ".join(filter(None, (count, note, rest))), err=True)

        task = CountedTask(total, show)
        yield task
        note = f", {task.note}" if task.note else ""
        click.echo(f"{label}: done in {time.monotonic() - begin:.1f} s{note}", err=True)

    def info(self, text: str) -> None:
        click.echo(printable(text), err=True)


class BarReporter:
    """Bars with the time left, remarks above them. The display lives as long as the outermost task."""

    def __init__(self) -> None:
        from rich.console import Console

        # Not sys.stderr, which escapes (see `cleargs.cli.terminal`): bars move the cursor.
        self._console = Console(file=sys.__stderr__)
        self._progress: Progress | None = None

    @contextmanager
    def task(self, label: str, total: int | None = None) -> Iterator[Task]:
        if self._progress is not None:
            yield from self._bar(self._progress, label, total)
            return
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

        self._progress = Progress(
            TextColumn("{task.description}", markup=False),
            BarColumn(bar_width=24),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TextColumn("{task.fields[left]}"),
            TextColumn("{task.fields[note]}", markup=False),
            console=self._console,
        )
        try:
            with self._progress:
                yield from self._bar(self._progress, label, total)
        finally:
            self._progress = None

    def _bar(self, progress: Progress, label: str, total: int | None) -> Iterator[Task]:
        bar = progress.add_task(printable(label), total=total, left="", note="")

        def show(done: int, note: str, left: float | None) -> None:
            time_left = f"{timedelta(seconds=round(left))} left" if left else ""
            progress.update(bar, completed=done, note=note, left=time_left)

        yield CountedTask(total, show)
        progress.stop_task(bar)

    def info(self, text: str) -> None:
        self._console.print(printable(text), markup=False, highlight=False)

    def warn(self, text: str) -> None:
        self._console.print(f"warning: {printable(text)}", style="yellow", markup=False, highlight=False)
