"""A report replaces an older report, and nothing else; links in a report are not followed."""

from __future__ import annotations

import http.client
import os
import zipfile
from pathlib import Path

import pyarrow as pa
import pytest
from report_run import FinishedRun
from watched import reported, serving

from cleargs.capture.tables import FRAMES, load_frames
from cleargs.cli.main import invoke
from cleargs.errors import StoreError
from cleargs.parquet import read_table, write_table
from cleargs.report.report_json import require_own


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> FinishedRun:
    return reported(tmp_path_factory.mktemp("own"))


@pytest.mark.parametrize(
    "name",
    ["report/thesis.tex", "report/index.html", "report/scene.jpg", "report.html", "report/frames/a.jpg"],
)
def test_files_of_the_user_are_not_replaced(name: str, tmp_path: Path) -> None:
    mine = tmp_path / name
    mine.parent.mkdir(parents=True, exist_ok=True)
    mine.write_text("years of work")
    with pytest.raises(StoreError, match=f"{mine.name}: not made by ClearGS"):
        require_own(tmp_path)
    assert mine.read_text() == "years of work"


def test_a_file_of_the_user_in_a_report_of_ours_stays(finished: FinishedRun) -> None:
    require_own(finished.folder)
    mine = finished.folder / "report" / "notes.txt"
    mine.write_text("years of work")
    assert invoke(["report", str(finished.folder), "-q"]) == 1
    assert mine.read_text() == "years of work"
    mine.unlink()
    assert invoke(["report", str(finished.folder), "-q"]) == 0


def test_the_report_of_a_killed_process_is_removed(finished: FinishedRun) -> None:
    for name in (".0123abcd.partial.report", ".0123abcd.partial.report.old"):
        (finished.folder / name).mkdir()
        os.utime(finished.folder / name, (0, 0))
    require_own(finished.folder)
    assert not list(finished.folder.glob(".*partial*"))


def test_links_in_a_report_are_neither_packed_nor_served(finished: FinishedRun, tmp_path: Path) -> None:
    secret = tmp_path / "secret"
    secret.write_text("TOP-SECRET")
    inside = tmp_path / "folder"
    inside.mkdir()
    (inside / "secret").write_text("TOP-SECRET")
    run = finished.folder
    (run / "eval").mkdir()
    links = [run / "report" / "a.txt", run / "eval" / "eval.json", run / "report" / "index.html"]
    page = links[-1].read_bytes()
    links[-1].unlink()
    for link in links:
        link.symlink_to(secret)
    folder = run / "report" / "folder"
    folder.symlink_to(inside)
    try:
        assert invoke(["pack", str(run), "-o", str(tmp_path / "run.zip")]) == 0
        with zipfile.ZipFile(tmp_path / "run.zip") as packed:
            assert not [name for name in packed.namelist() if b"TOP-SECRET" in packed.read(name)]
            assert "run/report/scene.jpg" in packed.namelist()
        with serving(finished) as port:
            for path in ("", "index.html", "a.txt", "folder/secret", "folder/"):
                connection = http.client.HTTPConnection("127.0.0.1", port, timeout=20)
                connection.request("GET", f"/report/{path}")
                answer = connection.getresponse()
                assert answer.status == 404 and b"TOP-SECRET" not in answer.read()
                connection.close()
    finally:
        for link in (*links, folder):
            link.unlink()
        links[-1].write_bytes(page)
        (run / "eval").rmdir()


def test_a_table_may_not_name_images_outside(tmp_path: Path) -> None:
    run = FinishedRun(tmp_path)
    table = run.folder / "ingest" / "frames.parquet"
    rows = read_table(table, FRAMES).to_pylist()
    rows[0]["image"] = "../../secret.png"
    write_table(table, pa.Table.from_pylist(rows, FRAMES), FRAMES)
    with pytest.raises(StoreError, match="outside"):
        load_frames(run.folder / "ingest")


@pytest.mark.parametrize("name", ["eval", "eval/room"])
def test_eval_writes_through_no_link(
    name: str, finished: FinishedRun, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    place = finished.folder / name
    place.parent.mkdir(exist_ok=True)
    place.symlink_to(tmp_path)
    try:
        assert invoke(["eval", str(finished.folder), "--reference", str(tmp_path)]) == 1
        assert f"{place} is a link" in capsys.readouterr().err
    finally:
        place.unlink()
        if place.parent != finished.folder:
            place.parent.rmdir()
