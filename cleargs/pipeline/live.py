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
from cleargs.pipeline.run_file import PROGRESS_FILE
from cleargs.pipeline.store import writer_is_alive
from cleargs.progress import COMPILING, PREVIEW, BothTasks, CountedTask, Reporter, Task
from cleargs.safe_io import FAULTS, read_json
from cleargs.timing import timed

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
    begun: float = 0.0
    """Start of the current task, in seconds since 1970."""

    @property
    def words(self) -> str:
        """The task, its steps and its figures, for example "G0, 130 of 800, training PSNR 24.10 dB"."""
        count = f"{self.done} of {self.total}" if self.total else str(self.done or "")
        return ", ".join(filter(None, (self.label, count, self.note)))


def _last_stage(run: Path) -> RunningStage | None:
    try:
        return RunningStage.model_validate(read_json(run / PROGRESS_FILE, MAX_BYTES, root=run))
    except FAULTS:  # ValidationError is a ValueError
        return None


def running_stage(run: Path, store: Path) -> RunningStage | None:
    """Return the progress of the run in the folder ``run``; None if no process is running it."""
    found = _last_stage(run)
    return found if found is not None and writer_is_alive(store / "work" / found.work) else None


def stage_at_work(run: Path, store: Path, *, stopped: bool = False) -> tuple[str, str] | None:
    """Return the stage that works or stopped before its end, and what it does or did; None without one.

    With ``stopped``, the caller is the process that worked, and stops.
    """
    found = _last_stage(run)
    if found is None:
        return None
    work = store / "work" / found.work
    if work.parent.is_symlink() or work.is_symlink() or not work.is_dir():
        return None
    if not stopped and writer_is_alive(work):
        return found.stage, f"running: {found.words}, for {max(0.0, time.time() - found.begun):.0f} s"
    nodes = [
        node
        for node in nodes_below(work / "checkpoints")
        if node.name != PREVIEW and node.is_file(follow_symlinks=False)
    ]
    kept = "no checkpoint yet"
    if nodes:
        step = _step_of(max(nodes, key=lambda node: node.stat().st_mtime_ns).path)
        found = found.model_copy(update={"done": max(found.done, step or 0)})  # it shows every tenth step
        kept = "continues from its last checkpoint" if step is None else f"checkpoint at {step}"
    return found.stage, f"interrupted at {found.words}; {kept}"


def _step_of(checkpoint: str) -> int | None:
    """Return the step of a checkpoint of a training; None for other files."""
    from safetensors import SafetensorError, safe_open  # takes 0.1 s to load

    try:
        with safe_open(checkpoint, "numpy") as tensors:
            return int(tensors.get_tensor("step"))
    except (OSError, SafetensorError, ValueError, TypeError):
        return None


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

    ``work`` is the work folder of the stage in the store. The progress file is removed when the block ends,
    and stays with the last state if the stage stops before its end.
    """
    path = run / PROGRESS_FILE
    first = RunningStage(stage=stage, work=work.name, label=stage, begun=time.time())
    recorder = RecordingReporter(reporter, path, first)
    try:
        yield recorder
    except BaseException as error:
        recorder.write()
        if isinstance(error, KeyboardInterrupt) and (
            found := stage_at_work(run, work.parent.parent, stopped=True)
        ):
            reporter.info(": ".join(found))
        raise
    with suppress(OSError):
        path.unlink(missing_ok=True)


class RecordingReporter:
    """Forward to a reporter, and write the task that advanced last to the progress file."""

    def __init__(self, reporter: Reporter, path: Path, first: RunningStage) -> None:
        self._reporter, self._path, self._state = reporter, path, first
        self.info, self.warn = reporter.info, reporter.warn
        self.write()
        self.compile_seconds = 0.0
        """Seconds in tasks called `COMPILING`."""

    @contextmanager
    def task(self, label: str, total: int | None = None) -> Iterator[Task]:
        task_of = {"label": label, "total": total, "begun": time.time()}

        def show(done: int, note: str, left: float | None) -> None:
            now = {**task_of, "done": done, "note": note, "seconds_left": left}
            self._state = self._state.model_copy(update=now)
            if time.monotonic() - self._written >= WRITE_INTERVAL_S:
                self.write()

        begun = time.monotonic()
        show(0, "", None)
        if total is None:  # nothing may come until its end
            self.write()
        with timed(label), self._reporter.task(label, total) as task:
            yield BothTasks(task, CountedTask(total, show))
        if label == COMPILING:
            self.compile_seconds += time.monotonic() - begun

    def write(self) -> None:
        """Write the present state."""
        self._written = time.monotonic()
        with suppress(StoreError):
            write_json(self._path, self._state.model_dump())
