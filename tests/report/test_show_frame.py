"""`cleargs show RUN --frame N`: data of one frame as text and JSON, and its layers as a PNG."""

from __future__ import annotations

import json
from pathlib import Path

import pyarrow as pa
import pytest
from report_run import COUNT, HEIGHT, HOSTILE, UNPLACED, FinishedRun

from cleargs.capture.tables import FRAMES
from cleargs.cli.main import invoke
from cleargs.formation.table import FORMATION
from cleargs.media.image import read_rgb
from cleargs.parquet import read_table, write_table

FOUND = {"model": "blur", "blur_px": 3.25, "explained": 0.625, "weight_before": 0.4, "weight_after": 0.75}


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    run = FinishedRun(tmp_path_factory.mktemp("frame"))
    numbers = dict.fromkeys(FORMATION.names, 0.0) | {"columns": False}
    rows = pa.Table.from_pylist([{**numbers, **FOUND, "frame_id": 2}], FORMATION)
    write_table(run.folder / "consolidate/formation.parquet", rows, FORMATION)
    return run.folder


def shown(run: Path, frame: int, capsys: pytest.CaptureFixture[str], *options: str) -> str:
    assert invoke(["show", str(run), "--frame", str(frame), *options]) == 0
    return capsys.readouterr().out


def test_a_frame_in_words_fits_100_columns(
    run: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "100")
    text = shown(run, 2, capsys, "-o", str(run / "two.png"))
    lines = [line for line in text.splitlines() if not line.startswith("written")]
    assert max(map(len, lines)) <= 100
    words = " ".join(text.split())
    assert (
        words.startswith("frame 2 training motion blur 3.2 px, simulated: counts 75 % file clip.mp4#2")
        and "time 0.07 s" in words
    )
    assert "pose camera at (-0.200, 0.060, " in words
    assert "role by RVA geometric, weight 0.40: B > 0.6, adds views" not in words  # R 0.8 and B 0.1 pass
    assert "R 0.80, B 0.10, G 0.30" in words and "worst cue motion blur 0.70" in words
    assert "motion blur, explains 62 % of the residual" in words
    assert "blur 3.25 px, rolling shutter 0.00 px" in words
    assert "weight 0.40 before image formation, 0.75 after it" in words
    assert "round 1 the restored frame (primary score)" in words
    assert "sharp-1: render 80.0, restored 87.0, observed 75.0" in words
    assert "final scene trained on the restored frame of round 1" in words
    assert f"written: {run}/two.png" in words


def test_a_frame_for_programs(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    facts = json.loads(shown(run, 4, capsys, "--json"))
    assert facts["name"] == "clip.mp4#4" and facts["rva"]["role"] == "reactivated"
    assert [(row["round"], row["accepted"]) for row in facts["rounds"]] == [(1, False)]
    assert facts["picture"] == f"{run}/frame-000004.png" and Path(facts["picture"]).is_file()
    facts = json.loads(shown(run, 2, capsys, "--json"))
    blur = facts["formation"]["blur_px"]
    assert blur["value"] == 3.25 and blur["meaning"].endswith("px")


def test_layers_are_side_by_side(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    facts = json.loads(shown(run, 1, capsys, "--json"))
    assert facts["layers"] == ["observed", "restored", "render", "final"]
    sheet = read_rgb(Path(facts["picture"]))
    assert sheet.shape[1] == 3 * 240 + 2 * 4, "three next to each other"
    tile = round(HEIGHT * 240 / 96)
    first, second = sheet[22 : 22 + tile, :240], sheet[22 : 22 + tile, 244:484]
    assert first.std() > 20 and abs(first.astype(float) - second).mean() > 3  # restored is darker


def test_a_frame_without_a_place_or_with_an_odd_name(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = " ".join(shown(run, UNPLACED, capsys).split())
    assert "pose none found role" in words and "round 1" not in words
    assert json.loads(shown(run, UNPLACED, capsys, "--json"))["layers"] == ["observed"]
    assert HOSTILE[0] in shown(run, 0, capsys)


def test_what_cannot_be_shown_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = FinishedRun(tmp_path).folder
    assert invoke(["show", str(run), "--frame", str(COUNT)]) == 2
    assert f"choose one from 0 to {COUNT - 1}" in capsys.readouterr().err
    assert invoke(["show", str(run), "rva", "--frame", "1"]) == 2
    assert "cannot be used with a stage" in capsys.readouterr().err


def test_a_damaged_table_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = FinishedRun(tmp_path).folder
    (run / "consolidate" / "formation.parquet").write_bytes(b"PAR1, and nothing after it")
    assert invoke(["show", str(run), "--frame", "1"]) == 1
    assert "cannot read the table formation.parquet" in capsys.readouterr().err


def test_brackets_in_names_are_no_markup(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "500")
    run = FinishedRun(tmp_path).folder
    path = run / "ingest" / "frames.parquet"
    rows = read_table(path, FRAMES).to_pylist()
    rows[0]["name"], rows[1]["name"] = "a[blue]b.jpg", "c[/front].jpg"
    write_table(path, pa.Table.from_pylist(rows, FRAMES), FRAMES)
    for row, name in zip(rows, ("a[blue]b", "c[/front]"), strict=False):
        assert invoke(["show", str(run), "--frame", str(row["frame_id"])]) == 0
        assert name in capsys.readouterr().out
