"""Progress on stderr: bars on a terminal, plain lines elsewhere, or JSON; and a log of it."""

from __future__ import annotations

import json
import os
import re
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from datetime import datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from cleargs.cli.commands import as_called
from cleargs.errors import InputError
from cleargs.files import disk_errors
from cleargs.own_files import append_own
from cleargs.pipeline.outputs import check_outputs
from cleargs.pipeline.run_file import RUN_FILE
from cleargs.progress import BothTasks, CountedTask, LineReporter, Reporter, Say, Task
from cleargs.safe_io import open_own, printable

if TYPE_CHECKING:
    from rich.progress import Progress

PROGRESS, LOG, VERBOSE = "cleargs.progress", "cleargs.log", "cleargs.verbose"
"""Entries of click's ``Context.meta``: ``--progress``, a function that writes to the log, and ``-v``."""

JSON_EVERY = 1.0
"""Minimum time between two progress events of one task, seconds."""


def make_reporter(quiet: bool = False) -> Reporter:
    """Return a reporter for stderr: bars on a terminal, lines elsewhere; only warnings if ``quiet``.

    ``--progress`` of the running command chooses one of these or JSON lines. The lines also go to the file of
    ``--log``.
    """
    context = click.get_current_context(silent=True)
    chosen = {} if context is None else context.meta
    progress, log = chosen.get(PROGRESS, "auto"), chosen.get(LOG)
    if context is not None and isinstance(log, LineFile):
        check_log(log.path, context)

    def echo(text: str) -> None:
        click.echo(printable(as_called(text)), err=True)

    say: Say = (lambda text: None) if quiet else echo
    if progress == "json":
        shown: Reporter = JsonReporter()
    elif progress == "auto" and sys.stderr.isatty() and not quiet:
        shown = BarReporter()
    else:
        shown = LineReporter(say, lambda text: echo(f"warning: {text}"), say)
    return shown if log is None else LoggingReporter(shown, log)


def check_log(path: Path, context: click.Context) -> None:
    """Raise InputError if ``path`` is an input of the running command or of its run, or no log at all."""
    given = {name: value for name, value in context.params.items() if isinstance(value, Path)}
    run = next((place for place in given.values() if (place / RUN_FILE).is_file()), None)
    inputs = [given[name] for name in ("source", "sheet", "target", "directory", "renders") if name in given]
    check_outputs([path], context.obj, run, inputs=[place for place in inputs if place != run])
    root = path.parent if _in_run(path) else None
    with suppress(OSError), os.fdopen(open_own(path, root), "rb") as file:  # none yet, a link or a device
        if (begin := file.read(30).lstrip()) and not re.match(rb"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d  ", begin):
            raise InputError(f"{path} exists, and is not a log of ClearGS", hint="choose another name")


def _in_run(path: Path) -> bool:
    return any((place / RUN_FILE).exists() for place in path.absolute().parents)


class LineFile:
    """A log with time stamps. Its lines are kept in memory until its folder contains the file ``needed``."""

    def __init__(self, path: Path, needed: str = ".") -> None:
        self.path, self._needed, self._waiting = path, path.parent / needed, [""]

    def __call__(self, text: str) -> None:
        self._waiting.append(f"{datetime.now():%Y-%m-%d %H:%M:%S}  {printable(text)}")
        if self._needed.exists():
            text = "".join(f"{line}\n" for line in self._waiting)
            with disk_errors(self.path):
                if _in_run(self.path):
                    append_own(self.path, text)  # another may have sent the run: links are not followed
                else:
                    with self.path.open("a", encoding="utf-8") as file:
                        file.write(text)
            self._waiting.clear()


class LoggingReporter:
    """A reporter that forwards to another one, and also passes each line to the function ``log``."""

    def __init__(self, shown: Reporter, log: Say) -> None:
        self._shown, self._lines = shown, LineReporter(log, lambda text: log(f"warning: {text}"), log)

    @contextmanager
    def task(self, label: str, total: int | None = None) -> Iterator[Task]:
        with self._shown.task(label, total) as first, self._lines.task(label, total) as second:
            yield BothTasks(first, second)

    def info(self, text: str) -> None:
        self._shown.info(text)
        self._lines.info(text)

    def warn(self, text: str) -> None:
        self._shown.warn(text)
        self._lines.warn(text)


class JsonReporter:
    """One JSON object per line on stderr. Its ``event`` is info, warning, begin, progress or end."""

    @contextmanager
    def task(self, label: str, total: int | None = None) -> Iterator[Task]:
        last = begin = time.monotonic()

        def show(done: int, note: str, left: float | None) -> None:
            nonlocal last
            if time.monotonic() - last >= JSON_EVERY:
                last = time.monotonic()
                figures = {"done": done, "total": total, "note": note, "seconds_left": left}
                self._print("progress", task=label, **figures)

        self._print("begin", task=label, total=total)
        task = CountedTask(total, show)
        yield task
        self._print("end", task=label, seconds=round(time.monotonic() - begin, 3), note=task.note)

    def info(self, text: str) -> None:
        self._print("info", text=text)

    def warn(self, text: str) -> None:
        self._print("warning", text=text)

    def _print(self, event: str, **facts: Any) -> None:
        click.echo(json.dumps({"event": event, **facts}), err=True)


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
        self._console.print(printable(as_called(text)), markup=False, highlight=False)

    def warn(self, text: str) -> None:
        self._console.print(f"warning: {printable(text)}", style="yellow", markup=False, highlight=False)
