"""Disks as people have them: without links, unplugged, moved; and locales that are not UTF-8."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from toy import Bench

from cleargs.cli.main import invoke
from cleargs.errors import StageError, StoreError
from cleargs.pipeline import runner
from cleargs.pipeline.run_file import read_run_file
from cleargs.pipeline.session import opened_store, resolve_run
from cleargs.progress import SilentReporter
from cleargs.run_results import scene_stage


@pytest.fixture
def no_links(monkeypatch: pytest.MonkeyPatch) -> None:
    """Refuse links and permissions with the error of exFAT and FAT32 on Linux."""

    def refuse(*paths: object, **options: object) -> None:
        raise OSError(38, "Function not implemented")

    for name in ("symlink", "link", "chmod"):
        monkeypatch.setattr(os, name, refuse)


def text(bench: Bench, stage: str = "total") -> str:
    return (bench.folder / stage / f"{stage}.txt").read_text()


@pytest.mark.usefixtures("no_links")
def test_a_run_on_a_disk_without_links(bench: Bench) -> None:
    assert [outcome.how for outcome in bench.run()] == ["made"] * 3
    first = text(bench)
    assert not any(path.is_symlink() for path in bench.root.rglob("*"))
    assert [outcome.how for outcome in bench.run()] == ["found"] * 3
    bench.run("square.power=3")
    assert text(bench) != first
    bench.run("square.power=2")
    assert text(bench) == first
    assert not [path for path in bench.folder.iterdir() if "link-" in path.name]


@pytest.mark.usefixtures("no_links")
def test_the_copied_scene_follows_the_run(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(runner, "SCENE", "total.txt")
    scene = bench.folder / "total.txt"
    for power in (2, 3, 3, 2):
        bench.run(f"square.power={power}")
        assert scene.read_text() == text(bench) and bench.remarks.warnings == []
    bench.run("square.power=3", until="square")
    assert not scene.exists()


@pytest.mark.usefixtures("no_links")
def test_a_scene_of_the_user_stays_on_a_disk_without_links(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(runner, "SCENE", "total.txt")
    bench.run()
    (bench.folder / "total.txt").write_text("edited")
    bench.run("square.power=3")
    assert (bench.folder / "total.txt").read_text() == "edited"
    assert any("was not made by ClearGS" in line for line in bench.remarks.warnings)


@pytest.mark.usefixtures("no_links")
@pytest.mark.parametrize("damage", [Path.unlink, lambda file: file.write_text("x")])
def test_a_damaged_copy_is_made_again(bench: Bench, damage: Callable[[Path], object]) -> None:
    bench.run()
    whole = text(bench)
    damage(bench.folder / "total/total.txt")
    assert invoke(["verify", str(bench.folder)], bench.dag) == 1
    assert [outcome.how for outcome in bench.run()] == ["found"] * 3
    assert text(bench) == whole and invoke(["verify", str(bench.folder)], bench.dag) == 0


@pytest.mark.usefixtures("no_links")
def test_collection_keeps_what_copies_name(bench: Bench) -> None:
    bench.run()
    bench.run("square.power=3")
    with opened_store(bench.store) as store:
        gone = store.collect(("count", "square", "total"), checkpoints=False, dry_run=False)
    assert {garbage.folder.parent.name for garbage in gone} == {"square", "total"}
    assert [outcome.how for outcome in bench.run("square.power=3")] == ["found"] * 3


@pytest.mark.usefixtures("no_links")
def test_a_changed_setting_hides_copies_too(bench: Bench) -> None:
    bench.run()
    bench.run("square.power=3", until="square")
    assert not (bench.folder / "total").exists() and (bench.folder / "count").exists()


@pytest.mark.usefixtures("no_links")
def test_a_copy_becomes_a_link_where_links_work(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    bench.run()
    monkeypatch.undo()
    bench.run("square.power=3")
    assert (bench.folder / "square").is_symlink()


@pytest.mark.parametrize("mount_point", [False, True])
def test_a_store_that_is_gone_is_named(bench: Bench, tmp_path: Path, mount_point: bool) -> None:
    disk = tmp_path / "disk"
    bench.run(store=disk / "store")
    bench.work_done()
    disk.rename(tmp_path / "unplugged")
    if mount_point:
        (disk / "store").mkdir(parents=True)
    with pytest.raises(StoreError, match=f"the store {disk / 'store'} of the run"):
        read_run_file(bench.folder, bench.dag)
    with pytest.raises(StoreError, match="is gone"):
        resolve_run(bench.dag, bench.capture, bench.folder, reporter=SilentReporter())
    with pytest.raises(StoreError, match="is gone"):
        scene_stage(bench.dag, bench.folder, None)
    elsewhere = tmp_path / "elsewhere"
    again = resolve_run(bench.dag, bench.capture, bench.folder, store=elsewhere, reporter=SilentReporter())
    assert again.store == elsewhere
    assert bench.work_done() == []
    shutil.rmtree(disk, ignore_errors=True)
    (tmp_path / "unplugged").rename(disk)
    assert [outcome.how for outcome in bench.run(store=disk / "store")] == ["found"] * 3


def test_a_store_that_went_during_the_first_stage_is_named(bench: Bench, tmp_path: Path) -> None:
    """The next try computed into the empty mount point."""
    disk = tmp_path / "disk"
    disk.mkdir()
    shutil.rmtree(bench.capture)
    bench.capture.write_text("no folder, so that the stage fails")
    with pytest.raises(StageError):
        bench.run(store=disk / "store")
    disk.rename(tmp_path / "unplugged")
    disk.mkdir()
    with pytest.raises(StoreError, match="is gone"):
        read_run_file(bench.folder, bench.dag)


def test_a_store_without_results_is_made(bench: Bench, tmp_path: Path) -> None:
    bench.run(store=tmp_path / "store")
    shutil.rmtree(tmp_path / "store")
    for link in bench.folder.iterdir():
        if link.is_symlink():
            link.unlink()
    assert read_run_file(bench.folder, bench.dag).store == tmp_path / "store"


def test_the_way_is_named_when_the_input_was_moved(bench: Bench, capsys: pytest.CaptureFixture[str]) -> None:
    bench.run()
    bench.capture.rename(bench.root / "moved")
    assert invoke(["status", str(bench.folder)], bench.dag) == 0
    said = capsys.readouterr()
    assert said.out.count("done") == 3 and f"cleargs run NEWPLACE -o {bench.folder}" in said.err
    assert invoke(["run", str(bench.folder)], bench.dag) == 2
    assert f"cleargs run NEWPLACE -o {bench.folder}" in capsys.readouterr().err
    assert invoke(["run", str(bench.root / "moved"), "-o", str(bench.folder), "--no-report"], bench.dag) == 0


LOCALE = {"LC_ALL": "C", "PYTHONCOERCECLOCALE": "0", "PYTHONUTF8": "0"}
"""Python's encoding of file names is not UTF-8 here, as in an old locale such as de_DE.ISO-8859-1."""


def test_any_character_in_any_locale(tmp_path: Path) -> None:
    folder = tmp_path / "Räume 房间"
    folder.mkdir()
    found = subprocess.run(
        [sys.executable, "-m", "cleargs", "run", str(folder), "--dry-run"],
        env={**os.environ, **LOCALE},
        capture_output=True,
        check=False,
    )
    assert found.returncode == 2 and b"holds no images" in found.stderr


def test_the_library_names_the_locale(tmp_path: Path) -> None:
    code = "import sys; from cleargs.safe_io import require_utf8 as r; r('plain'); r(sys.argv[1])"
    found = subprocess.run(
        [sys.executable, "-c", code, str(tmp_path / "Räume")],
        env={**os.environ, **LOCALE},
        capture_output=True,
        check=False,
    )
    assert b"is not ASCII, and the locale has the encoding" in found.stderr
