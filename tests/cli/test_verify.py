"""``cleargs verify`` finds damage that no time stamp shows."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
from toy import Bench, make_bench

from cleargs.cli import store as store_commands
from cleargs.cli.main import invoke
from cleargs.digest import DigestMemo, file_digest


@pytest.fixture
def bench(tmp_path: Path) -> Bench:
    made = make_bench(tmp_path)
    made.run()
    return made


def rot(bench: Bench, file: Path) -> None:
    """Change one byte without a trace in any time stamp: the memo keeps the old digest."""
    known = file_digest(file)
    data = bytearray(file.read_bytes())
    data[-1] ^= 1
    file.write_bytes(bytes(data))
    with DigestMemo(bench.store / "digests.json") as memo:
        memo.remember(file, known)


def test_a_healthy_run(bench: Bench, capsys: pytest.CaptureFixture[str]) -> None:
    assert invoke(["verify", str(bench.folder)], bench.dag) == 0
    assert "15 files of 3 stages read: all unchanged" in capsys.readouterr().out


def test_damage_is_named_and_repaired(bench: Bench, capsys: pytest.CaptureFixture[str]) -> None:
    healthy = bench.digests()
    rot(bench, (bench.folder / "count" / "numbers" / "3.txt").resolve())
    assert bench.run()[0].how == "found", "time stamps show nothing"
    assert invoke(["verify", str(bench.folder)], bench.dag) == 1
    told = capsys.readouterr()
    assert "damaged  count        numbers/3.txt has other content" in told.out
    assert "15 files of 3 stages read: 1 fault" in told.out and "replace damaged results with" in told.err
    assert bench.run()[0].how == "made"
    assert bench.digests() == healthy
    assert invoke(["verify", str(bench.folder)], bench.dag) == 0


def test_changed_and_missing_inputs(bench: Bench, capsys: pytest.CaptureFixture[str]) -> None:
    rot(bench, bench.capture / "3.txt")
    (bench.capture / "4.txt").unlink()
    (bench.capture / "9.txt").write_text("9")
    assert invoke(["verify", str(bench.folder), "--json"], bench.dag) == 1
    faults = json.loads(capsys.readouterr().out)["faults"]
    assert [(fault["kind"], fault["what"]) for fault in faults] == [
        ("changed", "capture 3.txt has other content"),
        ("changed", "capture 4.txt is missing"),
        ("changed", "capture 9.txt is new"),
    ]


def test_a_result_that_left_the_store(bench: Bench, capsys: pytest.CaptureFixture[str]) -> None:
    for folder in (bench.store / "total").iterdir():
        folder.rename(bench.root / "away")
    assert invoke(["verify", str(bench.folder)], bench.dag) == 1
    assert "total        it is no longer in the store" in capsys.readouterr().out


def test_a_copy_without_links_can_be_checked(bench: Bench, capsys: pytest.CaptureFixture[str]) -> None:
    copy = bench.root / "copy"
    shutil.copytree(bench.folder, copy)
    assert invoke(["verify", str(copy)], bench.dag) == 0
    assert "15 files of 3 stages read: all unchanged" in capsys.readouterr().out
    (copy / "count" / "numbers" / "3.txt").write_text("rotten")
    assert invoke(["verify", str(copy)], bench.dag) == 1


def test_a_run_without_results_is_not_called_healthy(
    bench: Bench, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in bench.dag.names:
        (bench.folder / name).unlink()
    assert invoke(["verify", str(bench.folder)], bench.dag) == 2
    assert "has no results yet" in capsys.readouterr().err


@pytest.mark.parametrize("target", ["gone", "../outside", "count"])
@pytest.mark.parametrize("in_store", [False, True])
def test_a_link_that_the_store_did_not_make_is_not_opened(
    bench: Bench,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    target: str,
    in_store: bool,
) -> None:
    place = (bench.folder / "count").resolve() if in_store else bench.folder / "count"
    place.rename(bench.root / "away")
    place.symlink_to(target)
    opened: list[Path] = []
    read = store_commands.read_manifest
    monkeypatch.setattr(
        store_commands, "read_manifest", lambda folder: (opened.append(folder), read(folder))[1]
    )
    assert invoke(["verify", str(bench.folder)], bench.dag) == 1
    assert "count        there is a link or a device in it, or it is a link" in capsys.readouterr().out
    assert len(opened) == 2 and place not in opened
