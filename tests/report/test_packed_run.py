"""A packed and unpacked run says what it is, and does what it can."""

from __future__ import annotations

import json
import os
import time
import zipfile
from pathlib import Path

import pytest
from colmap_model import write_no_formation, write_sparse
from report_run import FinishedRun

import cleargs as cg
from cleargs.cli.main import invoke
from cleargs.errors import InputError
from cleargs.packed import PACK

FRAMES = 7
DAY = time.mktime((2021, 3, 4, 5, 6, 8, 0, 0, -1))


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> FinishedRun:
    run = FinishedRun(tmp_path_factory.mktemp("packs"), name="room")
    write_sparse(run.folder / "ingest")
    write_no_formation(run.folder / "consolidate")
    run.finish("consolidate", {"psnr_unseen": 24.6})
    (run.folder / "report").mkdir()
    (run.folder / "report/index.html").write_text('<html lang="en"><a href="../consolidate/scene.ply">')
    (run.folder / "report.html").write_text("the entry")
    for file in run.folder.rglob("*"):
        os.utime(file, (DAY, DAY))
    os.utime(run.folder / "rva/frames.parquet", (0, 0))  # before 1980, which ZIP files cannot express
    return run


@pytest.fixture
def packed(whole: FinishedRun, tmp_path: Path) -> Path:
    assert invoke(["pack", str(whole.folder), "-o", str(tmp_path / "a.zip")]) == 0
    with zipfile.ZipFile(tmp_path / "a.zip") as archive:
        archive.extractall(tmp_path)
    return tmp_path / "room"


def text(captured: pytest.CaptureFixture[str]) -> str:
    told = captured.readouterr()
    return told.out + told.err


@pytest.mark.parametrize("path", [".", "..", "../..", "{}/", "{}/eval/..", "link", "link/"])
def test_a_pack_has_the_name_of_its_folder(
    whole: FinishedRun, path: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (whole.folder / "eval/novel").mkdir(parents=True, exist_ok=True)
    depth = path.count("..") if path.startswith(".") else 0
    working = (whole.folder, whole.folder / "eval", whole.folder / "eval/novel")[depth]
    if path.startswith("link"):
        (tmp_path / "link").symlink_to(whole.folder)
        working = tmp_path
    monkeypatch.chdir(working)
    assert invoke(["pack", path.format(whole.folder), "--force"]) == 0
    made = working / "room.zip"
    with zipfile.ZipFile(made) as archive:
        assert {name.partition("/")[0] for name in archive.namelist()} == {"room"}
    made.unlink()


def test_files_keep_their_dates_and_the_scene_is_at_the_top(whole: FinishedRun, packed: Path) -> None:
    with zipfile.ZipFile(packed.parent / "a.zip") as archive:
        dates = {entry.filename: entry.date_time for entry in archive.infolist()}
    assert dates["room/scene.ply"] == dates["room/g0/manifest.json"] == (2021, 3, 4, 5, 6, 8)
    assert dates["room/rva/frames.parquet"] == (1980, 1, 1, 0, 0, 0)
    assert (packed / "scene.ply").read_bytes() == (whole.folder / "consolidate/scene.ply").read_bytes()
    assert not (packed / "consolidate/scene.ply").exists(), "the scene is not packed twice"
    assert 'href="../scene.ply"' in (packed / "report/index.html").read_text()
    assert "packed_run" in json.loads((packed / PACK).read_text())


def test_verify_reads_what_was_packed(packed: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert invoke(["verify", str(packed)]) == 0
    told = text(capsys)
    assert "all unchanged" in told and "other files were left out" in told
    for name, change in (("scene.ply", "has another"), ("rva/frames.parquet", "is missing")):
        content = (packed / name).read_bytes()
        (packed / name).write_bytes(content[:-1]) if "another" in change else (packed / name).unlink()
        assert invoke(["verify", str(packed)]) == 1
        told = text(capsys)
        assert f"{Path(name).name} {change}" in told and "unpack the ZIP file again" in told
        assert "1 fault" in told and "cleargs run" not in told
        (packed / name).write_bytes(content)
    for file in (packed / "g0").iterdir():
        file.unlink()
    (packed / "g0").rmdir()
    assert invoke(["verify", str(packed)]) == 1
    assert "manifest.json is missing" in text(capsys)


@pytest.mark.parametrize(
    "command",
    [
        ["run", "{}"],
        ["run", "{}/../clip", "-o", "{}"],
        ["stage", "g0", "{}"],
        ["eval", "{}"],
        ["render", "{}", "-o", "{}/../a.png", "--frame", "3", "--side-by-side"],
        ["pack", "{}", "-o", "{}/../b.zip"],
    ],
)
def test_work_that_needs_images_is_refused(
    packed: Path, command: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    (packed.parent / "clip").mkdir()
    assert invoke([word.format(packed) for word in command]) == 2
    told = text(capsys)
    assert "is a packed run" in told and "show, render, export" in told and "cannot read" not in told


def test_functions_that_need_images_are_refused(packed: Path, tmp_path: Path) -> None:
    run = cg.open_run(packed)
    assert run.scene().gaussians.num == 4000 and run.scene_file() == packed / "scene.ply"
    for call in (
        lambda: cg.run(tmp_path / "clip", packed),
        lambda: cg.deblur(run, 3),
        lambda: cg.evaluate_scene(run),
        lambda: cg.open_prepared(run["ingest"]).to_nerfstudio(tmp_path / "n"),
        lambda: cg.open_prepared(run["ingest"]).views(),
    ):
        with pytest.raises(InputError, match="is a packed run"):
            call()
    assert not (tmp_path / "n").exists()


def test_what_a_packed_run_can_do(packed: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = str(packed)
    assert invoke(["status", run]) == 0
    told = text(capsys)
    assert told.count("packed  ") == 5 and "packed run: show, render" in told
    assert invoke(["status", run, "--json"]) == 0
    assert {plan["state"] for plan in json.loads(capsys.readouterr().out)} == {"packed"}
    assert invoke(["show", run]) == 0 and "packed run: show" in text(capsys)
    assert invoke(["show", run, "--frame", "3"]) == 0
    told = text(capsys)
    assert "scores" in told and "no picture: a packed run has no images" in told
    assert not (packed / "frame-000003.png").exists()
    assert invoke(["show", run, "--frame", "3", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["picture"] is None
    assert invoke(["report", run, "--single-file", "-o", str(tmp_path / "a.html")]) == 0
    assert "as it was packed" in text(capsys) and (tmp_path / "a.html").is_file()
    assert invoke(["render", run, "-o", str(tmp_path / "a.png"), "--frame", "3"]) == 0
    for more in ([], ["--prune", "opacity:0.1"], ["--prune", "contribution:0.1"]):
        assert invoke(["export", run, "-o", str(tmp_path / "a.ply"), "--force", *more]) == 0
    assert "no images to measure the PSNR" in text(capsys)
    assert invoke(["diff", run, run]) == 0
    (packed / "report/index.html").unlink()
    assert invoke(["report", run]) == 2 and "is a packed run" in text(capsys)


def test_a_damaged_note_is_named(packed: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (packed / PACK).write_text("{")
    assert invoke(["status", str(packed)]) == 1
    assert f"cannot read {packed / PACK}" in text(capsys)
