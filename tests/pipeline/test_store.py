"""The store never uses damaged results, publishes atomically, and keeps the results that runs link to."""

from __future__ import annotations

import json
import os
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from toy import Bench

from cleargs.digest import RACY_NS, DigestMemo, file_digest
from cleargs.errors import StageError, StoreError
from cleargs.manifest import MANIFEST, damages, read_manifest
from cleargs.pipeline.lock import file_lock
from cleargs.pipeline.stage import StageContext, StageResult
from cleargs.pipeline.store import Store


def flip(file: Path) -> None:
    """Change the content but not the size."""
    data = bytearray(file.read_bytes())
    data[-1] ^= 1
    file.write_bytes(bytes(data))


def edit_manifest(folder: Path) -> None:
    content = json.loads((folder / MANIFEST).read_text())
    content["summary"]["numbers"] = 7
    (folder / MANIFEST).write_text(json.dumps(content))


def from_elsewhere(folder: Path) -> None:
    other = next(folder.parent.glob("square"))
    shutil.copy(other / MANIFEST, folder / MANIFEST)


def deep(folder: Path) -> None:
    (folder / MANIFEST).write_text("[" * 200_000)


def pipe(folder: Path) -> None:
    (folder / MANIFEST).unlink()
    os.mkfifo(folder / MANIFEST)


def no_digest(folder: Path) -> None:
    content = json.loads((folder / MANIFEST).read_text())
    content["files"]["log.txt"]["digest"] = None
    (folder / MANIFEST).write_text(json.dumps(content))


DAMAGES: dict[str, Callable[[Path], object]] = {
    "cut manifest": lambda folder: (folder / MANIFEST).write_bytes((folder / MANIFEST).read_bytes()[:-40]),
    "empty manifest": lambda folder: (folder / MANIFEST).write_bytes(b""),
    "binary manifest": lambda folder: (folder / MANIFEST).write_bytes(b"\xff\x00" * 50),
    "manifest is a list": lambda folder: (folder / MANIFEST).write_text("[]"),
    "edited manifest": edit_manifest,
    "manifest of another stage": from_elsewhere,
    "no manifest": lambda folder: (folder / MANIFEST).unlink(),
    "deep manifest": deep,
    "pipe for a manifest": pipe,
    "digest that is none": no_digest,
    "file gone": lambda folder: (folder / "log.txt").unlink(),
    "file cut": lambda folder: (folder / "numbers" / "1.txt").write_bytes(b""),
    "file changed": lambda folder: flip(folder / "numbers" / "1.txt"),
}


@pytest.mark.parametrize("what", DAMAGES)
def test_damage_is_a_miss_with_a_warning(bench: Bench, what: str) -> None:
    healthy = {outcome.stage: outcome.manifest.digest for outcome in bench.run()}
    bench.work_done()
    DAMAGES[what](bench.folder / "count")
    assert bench.plan()["count"].state == "missing"
    outcomes = bench.run()
    assert len(bench.remarks.warnings) == 1 and "damaged" in bench.remarks.warnings[0]
    assert outcomes[0].how == "made"
    assert {outcome.stage: outcome.manifest.digest for outcome in outcomes} == healthy
    assert [outcome.how for outcome in bench.run()] == ["found"] * 3


@pytest.mark.parametrize("content", [b"", b"no database", b"SQLite format 3\x00" + b"\x07" * 4096])
def test_damaged_memo_is_replaced(bench: Bench, content: bytes) -> None:
    bench.run()
    (bench.store / "digests.json").write_bytes(content)
    assert [outcome.how for outcome in bench.run()] == ["found"] * 3
    file = bench.root / "file"
    file.write_text("content")
    for known in ("what was noted", file_digest(file)):
        with DigestMemo(bench.store / "digests.json") as memo:
            memo.remember(file, known)
        with DigestMemo(bench.store / "digests.json") as memo:
            assert memo.digest(file) == known, "it works again"


def test_wrong_digest_in_the_memo_is_checked(tmp_path: Path, bench: Bench) -> None:
    bench.run()
    folder = (bench.folder / "count").resolve()
    with DigestMemo(tmp_path / "memo.json") as memo:
        memo.remember(folder / "log.txt", "0" * 64)
        manifest = read_manifest(folder)
        assert not list(damages(folder, manifest, manifest.files, memo))


def test_memo_is_used_only_for_the_same_file(tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.write_bytes(b"one")
    with DigestMemo(tmp_path / "memo.json") as memo:
        memo.remember(file, "what was noted")
        assert memo.digest(file) == "what was noted"
        other = tmp_path / "other"
        other.write_bytes(b"two")
        other.replace(file)  # the same size, another inode
        assert memo.digest(file) == file_digest(file)


def test_two_processes_may_use_the_memo_at_once(tmp_path: Path) -> None:
    files = [tmp_path / f"{number}.txt" for number in range(20)]
    for file in files:
        file.write_text(file.name)
    with DigestMemo(tmp_path / "memo.json") as one, DigestMemo(tmp_path / "memo.json") as two:
        for file in files[:15]:
            one.remember(file, "one")
        for file in files[5:]:
            two.remember(file, "one")
    with DigestMemo(tmp_path / "memo.json") as memo:
        assert {memo.digest(file) for file in files} == {"one"}


def test_a_forgotten_digest_stays_forgotten(tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.write_bytes(b"one")
    with DigestMemo(tmp_path / "memo.json") as memo:
        memo.remember(file, "what was noted")
    with DigestMemo(tmp_path / "memo.json") as memo:
        memo.forget(file)
    with DigestMemo(tmp_path / "memo.json") as memo:
        assert memo.digest(file) == file_digest(file)


def test_leftovers_of_dead_writers_are_not_published(bench: Bench) -> None:
    bench.run(until="count")
    key = read_manifest(bench.folder / "count").key
    shutil.rmtree(bench.store / "count")
    out = bench.store / "work" / f"{key}" / "out"
    (out / "numbers").mkdir(parents=True)
    (out / "numbers" / ".99.partial.1.txt").write_text("half")
    (out / MANIFEST).write_text("{}")
    bench.run()
    assert not list(bench.store.rglob("*.partial.*"))


def test_run_folder_with_a_real_folder_in_the_way(bench: Bench) -> None:
    (bench.folder / "square").mkdir(parents=True)
    (bench.folder / "square" / "mine.txt").write_text("keep me")
    with pytest.raises(StoreError, match="not a link"):
        bench.run()
    assert (bench.folder / "square" / "mine.txt").exists()


def test_unwritable_run_folder(bench: Bench, tmp_path: Path) -> None:
    bench.folder.parent.mkdir(exist_ok=True)
    bench.folder.write_text("a file where the run folder should be")
    with pytest.raises(StoreError):
        bench.run()


def test_collect_keeps_what_runs_show(bench: Bench) -> None:
    bench.run("square.power=3")
    bench.run()
    with DigestMemo(bench.store / "digests.json") as memo:
        store = Store(bench.store, memo)
        (bench.store / "work" / f"{7:064x}" / "checkpoints").mkdir(parents=True)
        (store.root / "kept" / "square").mkdir(parents=True)
        shown = {(bench.folder / name).resolve() for name in bench.dag.names}
        assert {item.kind for item in store.collect(bench.dag.names, checkpoints=False, dry_run=True)} == {
            "finished"
        }
        removed = store.collect(bench.dag.names, checkpoints=False, dry_run=False)
        assert sorted(item.folder.parent.name for item in removed) == ["square", "total"]
        assert {folder for name in bench.dag.names for folder in (bench.store / name).iterdir()} == shown
        assert [item.kind for item in store.collect(bench.dag.names, checkpoints=True, dry_run=False)] == [
            "unfinished",
            "kept",
        ]
        with (
            file_lock(bench.store / "locks" / "store.lock", shared=True),
            pytest.raises(StoreError, match="a run is using"),
        ):
            store.collect(bench.dag.names, checkpoints=False, dry_run=False)
    assert [outcome.how for outcome in bench.run()] == ["found"] * 3
    assert bench.run("square.power=3")[1].how == "made"


def damage_unseen(file: Path) -> None:
    """Change one byte and restore the time stamps that a program can set."""
    before = file.stat()
    flip(file)
    os.utime(file, ns=(before.st_atime_ns, before.st_mtime_ns))


def test_damage_behind_an_old_mtime_is_noticed(bench: Bench) -> None:
    """``cp -p`` and archivers restore mtime. They cannot restore ctime."""
    bench.run()
    bench.run()  # all digests are remembered now
    damage_unseen(bench.folder / "count" / "log.txt")
    assert bench.run()[0].how == "made"
    assert "damaged" in bench.remarks.warnings[0]


def test_changed_input_behind_an_old_mtime_is_noticed(bench: Bench) -> None:
    for file in bench.capture.iterdir():
        os.utime(file, (1e9, 1e9))
    time.sleep(RACY_NS / 1e9 + 0.1)
    bench.run()
    damage_unseen(bench.capture / "3.txt")
    assert bench.run()[0].how == "made"


def rot(bench: Bench, file: Path) -> None:
    """Change one byte without a trace in any time stamp, as a failing disk does. The memo is not updated."""
    known = file_digest(file)
    flip(file)
    with DigestMemo(bench.store / "digests.json") as memo:
        memo.remember(file, known)


def test_a_stage_that_runs_reads_its_inputs_again(bench: Bench) -> None:
    bench.run()
    before = read_manifest(bench.folder / "count").key
    rot(bench, bench.capture / "3.txt")
    assert bench.run()[0].how == "found", "nothing runs, nothing is read"
    bench.run("count.mode=padded")
    made = read_manifest(bench.folder / "count")
    assert made.key != before
    assert made.origins["capture"]["3.txt"] == file_digest(bench.capture / "3.txt")


def test_a_stage_that_runs_finds_damage_upstream(bench: Bench) -> None:
    bench.run()
    rot(bench, (bench.folder / "count" / "numbers" / "3.txt").resolve())
    with pytest.raises(StoreError, match=r"count: .*damaged \(numbers/3\.txt has other content\)"):
        bench.run("square.power=3")
    assert bench.run("square.power=3")[0].how == "made"


def test_an_input_that_changes_during_a_stage_is_an_error(bench: Bench) -> None:
    stage = bench.dag.load("count")
    run = stage.run

    def meddling(context: StageContext[Any]) -> StageResult:
        (bench.capture / "5.txt").write_text("55")
        return run(context)

    object.__setattr__(stage, "run", meddling)
    with pytest.raises(StageError, match="changed while count was reading it"):
        bench.run()
    object.__setattr__(stage, "run", run)
    assert not (bench.folder / "count").exists()
    bench.run()
    assert (bench.folder / "count" / "numbers" / "5.txt").read_text() == "55"


def test_collecting_between_plan_and_work_costs_nothing(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`gc` removes results between the plan and the work of a run."""
    bench.run("square.power=3")
    bench.run()
    in_use = Store.in_use

    @contextmanager
    def late(store: Store) -> Iterator[None]:
        store.collect(bench.dag.names, checkpoints=False, dry_run=False)
        with in_use(store):
            yield

    monkeypatch.setattr(Store, "in_use", late)
    outcomes = bench.run("square.power=3")
    assert [outcome.how for outcome in outcomes] == ["found", "made", "made"]
    for name in bench.dag.names:
        assert (bench.folder / name).resolve().is_dir(), "no link dangles"


def test_links_among_leftovers_are_not_published(bench: Bench) -> None:
    healthy = bench.digests()
    key = read_manifest(bench.folder / "count").key
    shutil.rmtree(bench.store / "count")
    out = bench.store / "work" / key / "out"
    (out / "numbers").mkdir(parents=True)
    (out / "numbers" / "1.txt").symlink_to("/nowhere")
    (out / "secret").symlink_to("/etc/passwd")
    assert bench.digests() == healthy


def test_a_read_only_store_can_be_read(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    shared = bench.root / "shared"
    bench.run(store=shared)
    monkeypatch.setattr(os, "access", lambda path, mode: mode != os.W_OK or Path(path) != shared)
    before = sorted(shared.rglob("*"))
    (bench.folder / "total").unlink()
    assert [outcome.how for outcome in bench.run(store=shared)] == ["found"] * 3
    assert (bench.folder / "total" / "total.txt").exists() and sorted(shared.rglob("*")) == before
    with pytest.raises(StoreError, match="is read-only"):
        bench.run("square.power=3", store=shared)


def test_foreign_files_among_leftovers_are_not_published(bench: Bench) -> None:
    """Only files in LEFTOVERS stay from a killed attempt."""
    healthy = bench.digests()
    manifests = {name: read_manifest(bench.folder / name) for name in ("count", "square")}
    for name, places in {
        "count": ("notes.txt", ".DS_Store", "masks/1.txt", "numbers/deep/1.txt", "numbers/1.png"),
        "square": ("powers/extra.txt", "powers/total.txt", "total.txt"),
    }.items():
        shutil.rmtree(bench.store / name)
        for place in places:
            file = bench.store / "work" / f"{manifests[name].key}" / "out" / place
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_text("99")
    assert bench.digests() == healthy
    for name, manifest in manifests.items():
        assert set(read_manifest(bench.folder / name).files) == set(manifest.files)
