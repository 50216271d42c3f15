"""A job and its stage: what is noted, and what a signal does. Scripts play the commands of Slurm."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from cleargs.batch.folder import BatchFolder, Plan, Status

STAGE = """
import json, os, signal, socket, sys, time
from pathlib import Path

def interrupted(*_):
    Path("interrupted").touch()
    sys.exit(130)

signal.signal(signal.SIGINT, interrupted)
work = Path("store/work") / f"key@{socket.gethostname()}-{os.getpid()}-0" / "checkpoints"
work.mkdir(parents=True)
(work / "state").write_text("0")
Path("started").touch()
for step in range(int(sys.argv[1])):
    time.sleep(0.1)
    if Path("save").exists():
        (work / f"state{step}").write_text("1")
print("error: it cannot be done", file=sys.stderr)
missing = ["a frame"] if sys.argv[3] == "partial" else []
print(json.dumps({"digest": "abc", "status": sys.argv[3], "missing": missing}))
sys.exit(int(sys.argv[2]))
"""
"""``STEPS CODE STATUS``"""


class Job:
    """A watcher at work in a folder of its own."""

    def __init__(self, folder: Path, *arguments: str, slurm_state: str | None = None) -> None:
        self.path = folder
        (folder / "stage.py").write_text(STAGE)
        environment = {name: text for name, text in os.environ.items() if not name.startswith("SLURM")}
        if slurm_state is not None:
            for name, line in (("squeue", f"echo {slurm_state} 0"), ("scontrol", 'echo "$@" > requeued')):
                (folder / name).write_text(f"#!/bin/sh\n{line}\n")
                (folder / name).chmod(0o755)
            environment |= {"SLURM_JOB_ID": "17", "PATH": f"{folder}:{environment['PATH']}"}
        command = [sys.executable, "-m", "cleargs.batch.job", str(folder), "room", "g0", "--"]
        command += [sys.executable, "stage.py", *arguments]
        self.process = subprocess.Popen(command, cwd=folder, env=environment)

    def signal(self, number: signal.Signals) -> None:
        """Send it to the watcher and its stage, as Slurm does, once the stage is at work."""
        self.until("started")
        stage = int(next((self.path / "store/work").iterdir()).name.split("-")[-2])
        os.kill(self.process.pid, number)
        os.kill(stage, number)

    def until(self, name: str) -> None:
        deadline = time.monotonic() + 60
        while not (self.path / name).exists():
            assert time.monotonic() < deadline, f"no {name}"
            time.sleep(0.02)

    def ended(self) -> tuple[int, Status]:
        code = self.process.wait(timeout=60)
        status = BatchFolder(self.path).read_status("room", "g0")
        assert status is not None
        return code, status


@pytest.mark.parametrize(
    ("arguments", "code", "state", "cause", "finished"),
    [
        (("0", "0", "complete"), 0, "done", "", True),
        (("0", "3", "partial"), 3, "partial", "a frame", False),
        (("0", "3", "partial", "--allow-partial"), 0, "partial", "a frame", True),
        (("0", "1", "complete"), 1, "failed", "it cannot be done", False),
        (("0", "130", "complete"), 130, "interrupted", "", False),
    ],
)
def test_the_end_of_a_stage_is_noted(
    tmp_path: Path, arguments: tuple[str, ...], code: int, state: str, cause: str, finished: bool
) -> None:
    ended, status = Job(tmp_path, *arguments).ended()
    assert (ended, status.state, status.cause) == (code, state, cause)
    handle = BatchFolder(tmp_path).read_handle("room", "g0")
    assert (handle is not None) == finished
    if handle is not None:
        assert handle.digest == "abc"


@pytest.mark.parametrize(
    ("until", "report", "written"), [("g0", True, True), ("g0", False, False), ("rivr", True, False)]
)
def test_only_the_last_job_of_a_scene_writes_its_report(
    tmp_path: Path, until: str, report: bool, written: bool
) -> None:
    stages: dict[str, tuple[str, ...]] = {"g0": (), "rivr": ("g0",)}
    plan = Plan(
        watcher=(), program=(), options=(), stages=stages, until=until, report=report, scenes={"room": {}}
    )
    BatchFolder(tmp_path).write_plan(plan)
    assert Job(tmp_path, "0", "0", "complete").ended()[0] == 0
    called = BatchFolder(tmp_path).log("room", "g0").read_text().splitlines()[0]
    assert called.endswith(" complete --report" if written else " complete")


def test_a_stage_killed_from_outside_is_a_failure_that_says_so(tmp_path: Path) -> None:
    job = Job(tmp_path, "600", "0", "complete")
    job.until("started")
    os.kill(int(next((tmp_path / "store/work").iterdir()).name.split("-")[-2]), signal.SIGKILL)
    code, status = job.ended()
    assert code != 0
    assert (status.state, status.cause) == ("failed", "ended by signal 9")


def test_before_a_time_limit_the_stage_is_stopped_after_its_next_checkpoint(tmp_path: Path) -> None:
    job = Job(tmp_path, "600", "0", "complete", slurm_state="RUNNING")
    job.signal(signal.SIGTERM)
    time.sleep(1.5)
    assert job.process.poll() is None and not (tmp_path / "interrupted").exists(), "it waits"
    (tmp_path / "save").touch()
    code, status = job.ended()
    assert (code, status.state, status.job) == (130, "requeued", "17")
    assert (tmp_path / "interrupted").exists()
    assert (tmp_path / "requeued").read_text() == "requeue 17\n"


def test_a_cancelled_job_stops_at_once_and_stays_cancelled(tmp_path: Path) -> None:
    job = Job(tmp_path, "600", "0", "complete", slurm_state="COMPLETING")
    job.signal(signal.SIGTERM)
    code, status = job.ended()
    assert (code, status.state) == (130, "interrupted")
    assert (tmp_path / "interrupted").exists() and not (tmp_path / "requeued").exists()


def test_a_stage_that_ends_well_while_it_is_waited_for_is_done(tmp_path: Path) -> None:
    job = Job(tmp_path, "20", "0", "complete", slurm_state="RUNNING")
    job.signal(signal.SIGTERM)
    code, status = job.ended()
    assert (code, status.state) == (0, "done")
    assert not (tmp_path / "requeued").exists()


def test_ctrl_c_here_stops_the_stage(tmp_path: Path) -> None:
    job = Job(tmp_path, "600", "0", "complete")
    job.signal(signal.SIGINT)
    code, status = job.ended()
    assert (code, status.state) == (130, "interrupted")
