"""Progress of an active run: a small file in the run folder, which `cleargs watch` and `show` read.

Results do not depend on this file. If it cannot be written, the run continues.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import NamedTuple

from pydantic import Field

from cleargs.base_model import FrozenModel
from cleargs.errors import StoreError
from cleargs.files import write_json
from cleargs.own_files import nodes_below
from cleargs.pipeline.store import writer_is_alive
from cleargs.progress import COMPILING, PREVIEW, ForwardingTask, Reporter, Task
from cleargs.safe_io import FAULTS, read_json

PROGRESS_FILE = ".at_work.json"

MAX_BYTES = 16_384
"""Maximum size of a progress file that is read."""

WRITE_INTERVAL_S = 2.0
"""Seconds between two writes of the progress file, at least."""


class RunningStage(FrozenModel):
    """Progress of a stage."""

    stage: str
    work: str = Field(pattern=r"^[0-9A-Za-z][^/\x00]*$", max_length=200)
    """Name of its work folder in the store."""
    label: str
    """The current task."""
    done: int = 0
    total: int | None = None
    note: str = ""
    """A few figures: PSNR, Gaussians."""
    seconds_left: float | None = None
    """Time left for the current task."""


def running_stage(run: Path, store: Path) -> RunningStage | None:
    """Return the progress of the run in the folder ``run``; None if no process is running it."""
    try:
        found = RunningStage.model_validate(read_json(run / PROGRESS_FILE, MAX_BYTES, root=run))
    except FAULTS:  # ValidationError is a ValueError
        return None
    return found if writer_is_alive(store / "work" / found.work) else None


class Preview(NamedTuple):
    """A picture of the work so far."""

    version: int
    """Modification time in ns, which grows with every new picture."""
    path: Path


def preview_of(found: RunningStage, store: Path) -> Preview | None:
    """Return the newest preview of the running stage; None if there is none."""
    previews = []
    for node in nodes_below(store / "work" / found.work / "checkpoints"):
        with suppress(OSError):  # the stage replaced or removed it
            if node.name == PREVIEW and node.is_file(follow_symlinks=False):
                previews.append(Preview(node.stat().st_mtime_ns, Path(node.path)))
    return max(previews, default=None)


@contextmanager
def recorded_progress(reporter: Reporter, run: Path, stage: str, work: Path) -> Iterator[RecordingReporter]:
    """Yield a reporter that forwards to ``reporter`` and writes the progress of ``stage`` into ``run``.

    ``work`` is the work folder of the stage in the store. The progress file is removed when the block ends.
    """
    path = run / PROGRESS_FILE
    try:
        yield RecordingReporter(reporter, path, RunningStage(stage=stage, work=work.name, label=stage))
    finally:
        with suppress(OSError):
            path.unlink(missing_ok=True)


class RecordingReporter:
    """Forward to a reporter, and write the task that advanced last to the progress file."""

    def __init__(self, reporter: Reporter, path: Path, first: RunningStage) -> None:
        self._reporter, self._path, self._first = reporter, path, first
        self.info, self.warn = reporter.info, reporter.warn
        self._write(first)
        self.compile_seconds = 0.0
        """Seconds in tasks called `COMPILING`."""

    @contextmanager
    def task(self, label: str, total: int | None = None) -> Iterator[Task]:
        def show(done: int, note: str, left: float | None) -> None:
            if time.monotonic() - self._written >= WRITE_INTERVAL_S:
                now = {"label": label, "total": total, "done": done, "note": note, "seconds_left": left}
                self._write(self._first.model_copy(update=now))

        begun = time.monotonic()
        with self._reporter.task(label, total) as task:
            yield ForwardingTask(task, total, show)
        if label == COMPILING:
            self.compile_seconds += time.monotonic() - begun

    def _write(self, state: RunningStage) -> None:
        self._written = time.monotonic()
        with suppress(StoreError):
            write_json(self._path, state.model_dump())
