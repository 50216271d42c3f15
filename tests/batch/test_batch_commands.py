"""What `cleargs batch` and `cleargs batch-status` say when they cannot begin."""

from __future__ import annotations

import fcntl
import os
import signal
import threading
from pathlib import Path

import pytest
from toy_batch import ToyBatch

from cleargs.batch.folder import BatchFolder, Plan, Status
from cleargs.batch.resources import Wanted, resources
from cleargs.batch.snakemake import engine_at_work, only_batch
from cleargs.batch.status import scene_states
from cleargs.cli.main import invoke
from cleargs.errors import StageError


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


@pytest.mark.usefixtures("program")
@pytest.mark.parametrize(
    ("setting", "name", "words"),
    [
        ("rivr.primary_scorer", "nonesuch", "there is no scorer 'nonesuch'"),
        ("rivr.expert", "nonesuch", "there is no expert 'nonesuch'"),
        ("rivr.expert", "nafnet-gopro", "the model nafnet-gopro is not installed"),
    ],
)
def test_models_that_cannot_be_had_are_told_before_any_work(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    setting: str,
    name: str,
    words: str,
) -> None:
    monkeypatch.setenv("CLEARGS_MODELS", str(tmp_path / "models"))
    sheet = tmp_path / "sheet.csv"
    (tmp_path / "hall.mp4").touch()
    sheet.write_text(f"name,input,{setting}\nhall,hall.mp4,{name}\n")
    assert invoke(["batch", str(sheet)]) == 2
    assert any(line.startswith(f"{sheet}:2: ") and words in line for line in said(capsys))


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


def test_a_sheet_is_checked_without_an_engine(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("CLEARGS_SNAKEMAKE", raising=False)
    monkeypatch.setattr("sys.prefix", str(tmp_path / "venv"))
    monkeypatch.setenv("PATH", str(tmp_path))
    (tmp_path / "hall.mp4").touch()
    (tmp_path / "sheet.csv").write_text("name,input\nhall,hall.mp4\n")
    assert invoke(["batch", str(tmp_path / "sheet.csv"), "--dry-run"]) == 0
    streams = capsys.readouterr()
    assert "1 scenes, 5 stages to do" in streams.out and "note: Snakemake" in streams.err


@pytest.mark.parametrize("named", ["", "nowhere"])
def test_an_engine_that_is_no_program_is_said_so(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, named: str
) -> None:
    monkeypatch.setenv("CLEARGS_SNAKEMAKE", str(tmp_path / named))  # the folder itself, or nothing
    (tmp_path / "sheet.csv").write_text("name,input\n")
    assert invoke(["batch", str(tmp_path / "sheet.csv")]) == 2
    assert "which is no program" in said(capsys)[0]


@pytest.mark.usefixtures("program")
def test_a_sheet_in_the_place_of_its_own_folder(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "hall").touch()
    sheet = tmp_path / "sheet.batch"
    sheet.write_text('[[scene]]\nname = "hall"\ninput = "hall"\n')
    assert invoke(["batch", str(sheet)]) == 1
    cause, remedy = said(capsys)
    assert str(sheet) in cause and "-o" in remedy
    assert sheet.is_file()


def test_an_interrupted_engine_that_lingers_is_ended_by_the_next_batch(
    toy: ToyBatch, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As Snakemake does on a cluster, where it sleeps for minutes between two looks at its jobs."""
    lingers = toy.root / "snakemake"
    lingers.write_text("#!/bin/sh\ntrap '' INT\necho > lingers\nsleep 600\n")
    lingers.chmod(0o755)
    monkeypatch.setenv("CLEARGS_SNAKEMAKE", str(lingers))
    batch = toy.start(cwd=toy.root)
    toy.wait_until((toy.root / "lingers").exists)
    with pytest.raises(StageError, match="at work already"), only_batch(toy.folder):
        pass
    batch.send_signal(signal.SIGINT)
    batch.communicate(timeout=60)
    assert batch.returncode == 130
    monkeypatch.setattr("cleargs.batch.snakemake.LEAVE", 1.0)
    with only_batch(toy.folder):
        assert not toy.engine_lives()


def test_who_asks_whether_an_engine_is_at_work_is_in_nobodys_way(tmp_path: Path) -> None:
    folder = BatchFolder(tmp_path)
    with only_batch(folder) as lock:
        os.pwrite(lock, b"process 7 on here", 0)
        assert engine_at_work(folder) == "process 7 on here"
    with (tmp_path / "batch.lock").open() as watcher:
        fcntl.flock(watcher, fcntl.LOCK_SH)  # as another asker does
        assert engine_at_work(folder) is None
        release = threading.Timer(0.1, fcntl.flock, (watcher, fcntl.LOCK_UN))
        release.start()
        with only_batch(folder):
            pass
        release.join()


def test_a_result_that_no_longer_holds_is_waited_for_without_a_word(tmp_path: Path) -> None:
    """A dry run after a change of the capture takes the handle away; its job's last word was "done"."""
    folder = BatchFolder(tmp_path)
    stages = {"count": resources("count", None, Wanted(), "cpu")}
    plan = Plan(
        watcher=(), program=(), options=(), stages={"count": ()}, until="count", scenes={"hall": stages}
    )
    folder.write_status("hall", "count", Status(state="done", node="n1", started=0))
    (state,) = scene_states(folder, plan)
    assert (state.state, state.cause) == ("waiting", "")


def test_the_status_of_no_batch(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert invoke(["batch-status", str(tmp_path / "sheet.csv")]) == 2
    assert "there was no batch" in said(capsys)[0]


@pytest.mark.usefixtures("program")
def test_a_page_of_an_earlier_batch_is_told_of(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "hall.mp4").touch()
    sheet = tmp_path / "sheet.csv"
    sheet.write_text("name,input\nhall,hall.mp4\n")
    page = tmp_path / "sheet.batch" / "report" / "index.html"
    page.parent.mkdir(parents=True)
    page.touch()
    invoke(["batch", str(sheet), "--no-report"])
    assert f"note: {page} shows an earlier batch; without --no-report it is made anew" in said(capsys)
