"""Leases, and work folders that two writers cannot share."""

from __future__ import annotations

import errno
import json
import os
import subprocess
import sys
import tempfile
import time
from dataclasses import asdict
from pathlib import Path

import pytest
from toy import Bench

from cleargs.errors import StoreError
from cleargs.pipeline import store as store_module
from cleargs.pipeline.digest import DigestMemo
from cleargs.pipeline.lease import DEAD_AFTER, lease, living_holder, this_process
from cleargs.pipeline.lock import file_lock
from cleargs.pipeline.manifest import read_manifest
from cleargs.pipeline.store import Store


def pretend(path: Path, *, age: float = 0.0, **changes: object) -> Path:
    """A lease of another process, its last sign of life ``age`` seconds ago."""
    path.parent.mkdir(parents=True, exist_ok=True)
    here = this_process()
    path.write_text(json.dumps(asdict(here) | changes))
    os.utime(path, (time.time() - age,) * 2)
    return path


def dead_pid() -> int:
    """Number of a process that is gone."""
    process = subprocess.Popen([sys.executable, "-c", ""])
    process.wait()
    return process.pid


def test_a_lease_lives_as_long_as_its_block(tmp_path: Path) -> None:
    path = tmp_path / "leases" / "me.json"
    with lease(path):
        assert living_holder(path) == this_process()
    assert living_holder(path) is None and not path.exists()


def test_who_counts_as_dead(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "other.json"
    elsewhere = {"host": "another-node", "pid": dead_pid()}
    assert living_holder(pretend(path, **elsewhere)) is not None, "its pid means nothing here"
    assert living_holder(pretend(path, pid=dead_pid())) is None
    assert living_holder(pretend(path, born="1")) is None, "the pid came back"
    assert living_holder(pretend(path, age=DEAD_AFTER + 1)) is not None, "it stood still, and is there"
    assert living_holder(pretend(path, pid=dead_pid(), pid_space="pid:[1]")) is not None
    assert living_holder(pretend(path, age=DEAD_AFTER + 1, **elsewhere)) is None
    assert living_holder(pretend(path, age=DEAD_AFTER / 2, **elsewhere)) is not None
    assert living_holder(pretend(path, age=-3e8, **elsewhere)) is None, "a beat ten years from now"
    monkeypatch.setenv("SLURM_JOB_ID", "17")
    assert living_holder(pretend(path, job="17", **elsewhere)) is None, "Slurm ended that try of our job"
    assert living_holder(pretend(path, job="18", **elsewhere)) is not None
    for damaged in ("{", "[]", "[" * 100_000, '{"pid": "1\\u0000"}'):
        path.write_text(damaged)
        assert living_holder(path) is None
    assert living_holder(pretend(path, pid="1\0")) is None
    path.unlink()
    os.mkfifo(path)
    assert living_holder(path) is None


@pytest.fixture
def half_done(bench: Bench) -> Path:
    """The work folder that a writer on another node left after two of six numbers."""
    bench.run(until="count")
    key = bench.plan()["square"].key
    folder = bench.store / "work" / f"{key}@another-node-1-0"
    (folder / "out" / "powers").mkdir(parents=True)
    (folder / "checkpoints").mkdir()
    for number in (0, 1):
        (folder / "out" / "powers" / f"{number}.txt").write_text(str(number**2))
    (folder / "checkpoints" / "state.txt").write_text("2 1")
    bench.work_done()
    return folder


def test_work_of_a_dead_writer_is_taken_over(bench: Bench, half_done: Path) -> None:
    left = bench.store / "leases" / "another-node-1-0.json"
    pretend(left, host="another-node", age=DEAD_AFTER + 1)
    bench.run()
    assert [line for line in bench.work_done() if line.startswith("square ")] == [
        f"square {number}.txt" for number in (2, 3, 4, 5)
    ]
    assert not half_done.exists() and not left.exists()
    assert list((bench.store / "work").iterdir()) == [] == list((bench.store / "leases").iterdir())


def test_work_of_a_living_writer_is_waited_for(
    bench: Bench, half_done: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also where the file system has no locks: here nobody holds the lock of the key."""
    left = pretend(bench.store / "leases" / "another-node-1-0.json", host="another-node", job="17")
    waited = []

    def sleep(seconds: float) -> None:
        waited.append(seconds)
        if seconds == store_module.WAIT and waited.count(seconds) == 3:
            os.utime(left, (time.time() - DEAD_AFTER - 1,) * 2)

    monkeypatch.setattr(store_module.time, "sleep", sleep)
    bench.run(until="square")
    assert waited.count(store_module.WAIT) == 3  # the toy sleeps too, for no time
    assert "square: another run is at work on it (another-node, job 17); waiting" in bench.remarks.lines
    assert "square 0.txt" not in bench.work_done()


def test_a_lock_that_a_dead_node_left_is_passed_over(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    bench.run(until="count")
    monkeypatch.setattr(store_module, "DEAD_AFTER", 0.1)
    with file_lock(bench.store / "locks" / f"{bench.plan()['square'].key}.lock"):
        bench.run()
    assert "square: another run is at work on it; waiting" in bench.remarks.lines


def test_a_writer_that_was_taken_for_dead_publishes_nothing(bench: Bench) -> None:
    bench.run()
    manifest = read_manifest(bench.folder / "square")
    with DigestMemo(bench.root / "memo.sqlite") as memo:
        first, second = Store(bench.root / "shared", memo), Store(bench.root / "shared", memo)
        with first.in_use(), second.in_use():
            work = first.open_work(manifest.key, fresh=False, entry=None)
            (lost,) = (bench.root / "shared" / "leases").glob(f"{work.folder.name.partition('@')[2]}*")
            pretend(lost, host="another-node", age=DEAD_AFTER + 1)  # it stood still
            taken = second.open_work(manifest.key, fresh=False, entry=None)
            assert taken.folder != work.folder and not work.folder.exists()
            work.out.mkdir(parents=True)  # it continues as if nothing had happened
            with pytest.raises(StoreError, match="took over"):
                first.publish(work, manifest)


def test_what_a_failed_stage_left_is_nobodys(bench: Bench) -> None:
    """Else a process that lives on after a failure would be waited for by all others."""
    (bench.capture / "3.txt").write_text("no number")
    with pytest.raises(ValueError, match="no number"):
        bench.run()
    (left,) = (bench.store / "work").iterdir()
    assert left.name.endswith("@left") and (left / "checkpoints" / "state.txt").exists()
    assert list((bench.store / "leases").iterdir()) == []


def test_nothing_is_cleared_away_while_another_node_is_at_work(bench: Bench) -> None:
    bench.run()
    with DigestMemo(bench.store / "digests.sqlite") as memo:
        store = Store(bench.store, memo)
        held = pretend(bench.store / "leases" / "another-node-1-0.json", host="another-node")
        with pytest.raises(StoreError, match="at work"):
            store.collect(bench.dag.names, checkpoints=True, dry_run=False)
        os.utime(held, (0, 0))
        store.collect(bench.dag.names, checkpoints=True, dry_run=False)
        assert not held.exists()


def test_whoever_may_only_read_sees_who_is_at_work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Somebody else's run on another node: the time of the file server cannot be had there."""
    path = pretend(tmp_path / "other.json", host="another-node", pid=dead_pid())

    cause: OSError = PermissionError(errno.EACCES, "Permission denied")

    def refused(**options: object) -> None:
        raise cause

    monkeypatch.setattr(tempfile, "NamedTemporaryFile", refused)
    assert living_holder(path) is not None
    pretend(path, age=DEAD_AFTER + 60, host="another-node", pid=dead_pid())
    assert living_holder(path) is None
    cause = OSError(errno.ENOSPC, "No space left on device")
    with pytest.raises(OSError, match="No space"):  # a writer: this node's clock must not say who is dead
        living_holder(path)
