"""Locks: one process per work folder. On file systems without locks the rename decides."""

from __future__ import annotations

import errno
import fcntl
import os
import subprocess
import sys
import threading
from contextlib import ExitStack
from pathlib import Path

import pytest
from toy import Bench

from cleargs.digest import DigestMemo
from cleargs.errors import StoreError
from cleargs.manifest import read_manifest
from cleargs.pipeline.lock import exclusive_lock, file_lock, is_locked
from cleargs.pipeline.store import Store


@pytest.fixture
def no_locks(monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(handle: int, kind: int) -> None:
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(fcntl, "flock", refused)


def test_lock_excludes_and_ends_with_its_block(bench: Bench, tmp_path: Path) -> None:
    path = tmp_path / "locks" / "key.lock"
    assert not is_locked(path)
    with exclusive_lock(path, bench.remarks, "key") as locked, file_lock(path, wait=False) as second:
        assert (locked, second) == (True, False)
        assert is_locked(path) and path.read_text().startswith(f"process {os.getpid()} on ")
    assert not is_locked(path) and bench.remarks.lines == []
    with file_lock(path, shared=True), file_lock(path, shared=True, wait=False) as second:
        assert second and not is_locked(path)


def test_waits_for_a_holder_without_a_name(bench: Bench, tmp_path: Path) -> None:
    path = tmp_path / "key.lock"
    with ExitStack() as first:
        first.enter_context(file_lock(path))
        path.write_bytes(b"\xff")
        release = threading.Timer(0.2, first.pop_all().close)
        release.start()
        with exclusive_lock(path, bench.remarks, "square") as locked:
            assert locked
        release.join()
    assert bench.remarks.lines == ["square: another process works on it; waiting for it to end"]


@pytest.mark.usefixtures("no_locks")
def test_run_without_locks(bench: Bench) -> None:
    assert [outcome.how for outcome in bench.run()] == ["made"] * 3
    assert list((bench.store / "work").iterdir()) == []


@pytest.mark.usefixtures("no_locks")
def test_without_locks_the_rename_decides(bench: Bench) -> None:
    bench.run()
    manifest = read_manifest(bench.folder / "total")
    with DigestMemo(bench.root / "memo.json") as memo:
        first, second = Store(bench.root / "shared", memo), Store(bench.root / "shared", memo)
        second._owner_suffix = lambda: "@another-node-1"  # type: ignore[method-assign]
        key, result = manifest.key, (bench.folder / "total" / "total.txt").read_bytes()
        with first.lock(key, bench.remarks, "total") as locked, second.lock(key, bench.remarks, "total"):
            assert not locked
            works = [
                store.open_work(key, forced=False, entry=None, locked=False) for store in (first, second)
            ]
            for work in works:
                (work.out / "total.txt").write_bytes(result)
            assert first.publish(works[0], manifest) == second.publish(works[1], manifest) == manifest
        assert list((bench.root / "shared" / "work").iterdir()) == []


@pytest.mark.usefixtures("no_locks")
def test_without_locks_a_failed_attempt_is_resumed(bench: Bench) -> None:
    (bench.capture / "3.txt").write_text("no number")
    with pytest.raises(ValueError, match="no number"):
        bench.run()
    (left,) = (bench.store / "work").iterdir()
    assert "@" not in left.name and (left / "checkpoints" / "state.txt").exists()
    bench.work_done()
    with pytest.raises(ValueError, match="no number"):
        bench.run()
    assert "square 2.txt" not in bench.work_done()


@pytest.mark.usefixtures("no_locks")
def test_without_locks_nothing_is_removed(bench: Bench) -> None:
    bench.run("square.power=3")
    bench.run()
    with DigestMemo(bench.store / "digests.json") as memo:
        store = Store(bench.store, memo)
        assert store.collect(bench.dag.names, checkpoints=False, dry_run=True)
        with pytest.raises(StoreError, match="has no locks"):
            store.collect(bench.dag.names, checkpoints=False, dry_run=False)


def test_a_python_without_fcntl_works_without_locks(tmp_path: Path) -> None:
    script = (
        "import sys; sys.modules['fcntl'] = None\n"
        "from pathlib import Path; from cleargs.pipeline.lock import file_lock, is_locked\n"
        "path = Path(sys.argv[1])\n"
        "with file_lock(path) as held: print(held, is_locked(path))"
    )
    command = [sys.executable, "-c", script, str(tmp_path / "x.lock")]
    assert subprocess.run(command, capture_output=True, text=True).stdout == "None True\n"
