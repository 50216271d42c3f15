"""Progress on stderr: bars on a terminal, plain lines elsewhere."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from datetime import timedelta
from typing import TYPE_CHECKING

import click

from cleargs.progress import CountedTask, LineReporter, Reporter, Task
from cleargs.safe_io import printable

if TYPE_CHECKING:
    from rich.progress import Progress


def make_reporter(quiet: bool = False) -> Reporter:
    """Return a reporter for stderr: bars on a terminal, lines elsewhere; only warnings if ``quiet``."""
    if sys.stderr.isatty() and not quiet:
        return BarReporter()

    def echo(text: str) -> None:
        click.echo(printable(text), err=True)

    def no_echo(text: str) -> None:
        """Print nothing."""

    say = no_echo if quiet else echo
    return LineReporter(say, lambda text: echo(f"warning: {text}"), say)


class BarReporter:
    """Bars with the time left, and messages above them. The display ends with the outermost task."""

    def __init__(self) -> None:
        from rich.console import Console

        # Not sys.stderr, which escapes control characters (`cleargs.cli.terminal`): bars move the cursor.
        self._console = Console(file=sys.__stderr__)
        self._progress: Progress | None = None

    @contextmanager
    def task(self, label: str, total: int | None = None) -> Iterator[Task]:
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

        with ExitStack() as stack:
            if self._progress is None:
                self._progress = Progress(
                    TextColumn("{task.description}", markup=False),
                    BarColumn(bar_width=24),
                    MofNCompleteColumn(),
                    TimeElapsedColumn(),
                    TextColumn("{task.fields[left]}"),
                    TextColumn("{task.fields[note]}", markup=False),
                    console=self._console,
                )
                stack.callback(setattr, self, "_progress", None)
                stack.enter_context(self._progress)
            progress = self._progress
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
