"""A stage under watch: when its Slurm job nears the time limit, it is stopped right after a checkpoint.

Before the limit, and before a preemption, Slurm sends SIGTERM to every process of the job. The stage is
started with SIGTERM blocked; its watcher waits for the next checkpoint, then stops the stage with SIGINT, so
that nothing is lost, and puts the job back into the queue. A cancelled job gets SIGTERM as well, but Slurm no
longer calls it running: it stops at once and stays cancelled.
"""

from __future__ import annotations

import os
import signal
import subprocess
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import FrameType

from cleargs.pipeline.store import last_saved

LOOK_EVERY = 0.5
"""Seconds between two looks at signals and checkpoints."""
PATIENCE = 90.0
"""Seconds that a stage gets for its next checkpoint; SIGTERM comes 120 before the limit (the profile)."""
MAX_REQUEUES = 50
"""A job that meets its time limit more often makes no progress."""


@dataclass(frozen=True)
class SlurmJob:
    """The Slurm job that this process belongs to."""

    number: str

    @classmethod
    def mine(cls) -> SlurmJob | None:
        """The job around this process; None outside Slurm."""
        number = os.environ.get("SLURM_JOB_ID")
        return cls(number) if number else None

    def may_go_back(self) -> bool:
        """Whether Slurm calls the job running (a cancelled one is not) and it has not come back too often."""
        question = ["squeue", "--noheader", "--jobs", self.number, "--Format", "State:20,RestartCnt:10"]
        answer = subprocess.run(question, capture_output=True, text=True, check=False).stdout.split()
        return len(answer) == 2 and answer[0] == "RUNNING" and int(answer[1]) < MAX_REQUEUES

    def requeue(self) -> bool:
        """Put the job back into the queue; Slurm then ends all of it. Returns whether that was accepted."""
        return subprocess.run(["scontrol", "requeue", self.number], check=False).returncode == 0


def run_watched(command: Sequence[str], log: int, store: Path, job: SlurmJob | None) -> tuple[int, str, bool]:
    """Run ``command``, its standard error into the file handle ``log``.

    Returns exit code, standard output, and whether ``job`` should go back into the queue.
    """
    came: set[int] = set()

    def note(number: int, frame: FrameType | None) -> None:
        came.add(number)

    handlers = {number: signal.signal(number, note) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        with _inherited_block(signal.SIGTERM, wanted=job is not None):
            child = subprocess.Popen(
                command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=log, text=True
            )
        while not came:
            try:
                output, _ = child.communicate(timeout=LOOK_EVERY)
                return child.returncode, output, False
            except subprocess.TimeoutExpired:
                continue
        again = job is not None and signal.SIGINT not in came and job.may_go_back()
        if again:
            _await_checkpoint(child, store)
        child.send_signal(signal.SIGINT)
        output, _ = child.communicate()
        return child.returncode, output, again
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)


def _await_checkpoint(child: subprocess.Popen[str], store: Path) -> None:
    """Until ``child`` has written something whole into its work folder, ended, or tried our patience."""
    deadline, before = time.monotonic() + PATIENCE, last_saved(store, child.pid)
    while child.poll() is None and time.monotonic() < deadline and last_saved(store, child.pid) == before:
        time.sleep(LOOK_EVERY)


@contextmanager
def _inherited_block(number: int, *, wanted: bool) -> Iterator[None]:
    """Block the signal for the block: a process started in it never gets it, and one sent meanwhile waits."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {number} if wanted else set())
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
