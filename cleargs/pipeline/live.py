"""What a run is at work on, for whoever watches it: a note in the run folder, renewed while a stage works.

The note is a courtesy. Nothing rests on it: no key, no output, no decision, and a note that cannot be written
stops no work.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import NamedTuple

from cleargs.errors import StoreError
from cleargs.files import write_json
from cleargs.pipeline.store import writer_lives
from cleargs.progress import PREVIEW, Pace, Reporter, Task
from cleargs.untrusted import FAULTS, read_json

NOTE = ".at_work.json"

EVERY = 2.0
"""Seconds between two notes."""

_NUMBERS = (int, type(None))


@dataclass(frozen=True)
class AtWork:
    """How far a stage is."""

    stage: str
    work: str
    """Name of its work folder in the store."""
    label: str
    """What it does at present."""
    done: int
    total: int | None
    note: str
    """A few figures: PSNR, Gaussians."""
    seconds_left: float | None
    """Of what it does at present."""


def at_work(run: Path, store: Path) -> AtWork | None:
    """What the run in the folder ``run`` does now; None when it is not at work, or died."""
    try:
        found = AtWork(**read_json(run / NOTE))
    except FAULTS:
        return None
    texts = (found.stage, found.work, found.label, found.note)
    sound = all(isinstance(text, str) for text in texts) and Path(found.work).name == found.work
    sound = sound and isinstance(found.done, int) and isinstance(found.total, _NUMBERS)
    sound = sound and isinstance(found.seconds_left, (*_NUMBERS, float))
    return found if sound and writer_lives(store / "work" / found.work) else None


class Preview(NamedTuple):
    """A picture of the work so far."""

    version: int
    """Grows with every new one: the time stamp, ns."""
    path: Path


def preview_of(found: AtWork, store: Path) -> Preview | None:
    """The youngest preview that the stage at work left; None where there is none."""
    previews = []
    for path in (store / "work" / found.work / "checkpoints").rglob(PREVIEW):
        with suppress(OSError):  # replaced or removed meanwhile
            if path.is_file() and not path.is_symlink():
                previews.append(Preview(path.stat().st_mtime_ns, path))
    return max(previews, default=None)


@contextmanager
def noted(reporter: Reporter, run: Path, stage: str, work: Path) -> Iterator[Reporter]:
    """A reporter that passes everything on to ``reporter`` and notes in ``run`` how far ``stage`` is.

    The note goes when the block ends.
    """
    try:
        yield _NotingReporter(reporter, run / NOTE, stage, work.name)
    finally:
        with suppress(OSError):
            (run / NOTE).unlink(missing_ok=True)


class _NotingReporter:
    """Passes on, and notes the task that was told of last."""

    def __init__(self, reporter: Reporter, path: Path, stage: str, work: str) -> None:
        self._reporter, self._path, self._stage, self._work = reporter, path, stage, work
        self._write(AtWork(stage, work, stage, 0, None, "", None))

    @contextmanager
    def task(self, label: str, total: int | None = None) -> Iterator[Task]:
        with self._reporter.task(label, total) as task:
            yield _NotingTask(task, label, total, self)

    def info(self, text: str) -> None:
        self._reporter.info(text)

    def warn(self, text: str) -> None:
        self._reporter.warn(text)

    def tell(self, label: str, done: int, total: int | None, note: str, seconds_left: float | None) -> None:
        """Note the task, unless the last note is too young."""
        if time.monotonic() - self._noted >= EVERY:
            self._write(AtWork(self._stage, self._work, label, done, total, note, seconds_left))

    def _write(self, state: AtWork) -> None:
        self._noted = time.monotonic()
        with suppress(StoreError):
            write_json(self._path, asdict(state))


class _NotingTask:
    """One task, passed on and noted."""

    def __init__(self, task: Task, label: str, total: int | None, reporter: _NotingReporter) -> None:
        self._task, self._label, self._total, self._reporter = task, label, total, reporter
        self._done, self._note = 0, ""
        self._pace = Pace(total)

    def advance(self, steps: int = 1) -> None:
        self._task.advance(steps)
        self._tell(self._done + steps, self._note, None)

    def update(self, *, done: int | None = None, note: str | None = None, share: float | None = None) -> None:
        self._task.update(done=done, note=note, share=share)
        self._tell(self._done if done is None else done, self._note if note is None else note, share)

    def _tell(self, done: int, note: str, share: float | None) -> None:
        self._done, self._note = done, note
        left = self._pace.seconds_left(done, share)
        self._reporter.tell(self._label, done, self._total, note, left)
