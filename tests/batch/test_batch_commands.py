"""What `cleargs batch` and `cleargs batch-status` say when they cannot begin."""

from __future__ import annotations

from pathlib import Path

import pytest

from cleargs.cli.main import invoke


@pytest.fixture
def program(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A program in the engine's place: these tests do not come to call it."""
    monkeypatch.setenv("CLEARGS_SNAKEMAKE", "/bin/false")


def said(capsys: pytest.CaptureFixture[str]) -> list[str]:
    return capsys.readouterr().err.splitlines()


@pytest.mark.usefixtures("program")
def test_a_wrong_sheet_starts_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    sheet = tmp_path / "sheet.csv"
    sheet.write_text("name,input,g0.steps\nhall,nowhere.mp4,0\nhall,,\n")
    assert invoke(["batch", str(sheet)]) == 2
    lines = said(capsys)
    assert [line.split(":")[1] for line in lines[:-2]] == ["2", "2", "3", "3"]
    assert lines[-2].endswith("has 4 mistakes")
    assert [path.name for path in tmp_path.iterdir()] == ["sheet.csv"]


@pytest.mark.usefixtures("program")
def test_a_scene_whose_folder_belongs_to_another_input(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    sheet = tmp_path / "sheet.csv"
    run = tmp_path / "sheet.batch" / "scenes" / "hall"
    run.mkdir(parents=True)
    (run / "run.toml").write_text('input = "/elsewhere/hall.mp4"\n')
    (tmp_path / "other.mp4").touch()
    sheet.write_text("name,input\nhall,other.mp4\n")
    assert invoke(["batch", str(sheet)]) == 2
    assert said(capsys)[0].startswith(f"{sheet}:2: {run} is a run of /elsewhere/hall.mp4")


def test_no_engine_is_said_with_its_remedy(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("CLEARGS_SNAKEMAKE", raising=False)
    monkeypatch.setattr("sys.prefix", str(tmp_path / "venv"))
    monkeypatch.setenv("PATH", str(tmp_path))
    (tmp_path / "sheet.csv").write_text("name,input\n")
    assert invoke(["batch", str(tmp_path / "sheet.csv")]) == 2
    cause, remedy = said(capsys)
    assert "not installed" in cause and "make cluster" in remedy


def test_the_status_of_no_batch(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert invoke(["batch-status", str(tmp_path / "sheet.csv")]) == 2
    assert "there was no batch" in said(capsys)[0]
