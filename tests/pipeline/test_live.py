"""The progress file exists while a run works, and affects nothing."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any

import pytest
import torch
from test_interruption import start, wait_for
from toy import Bench

from cleargs.cli.main import invoke
from cleargs.errors import StoreError
from cleargs.pipeline import live
from cleargs.pipeline.live import RunningStage, preview_of, recorded_progress, running_stage, stage_at_work
from cleargs.pipeline.run_file import PROGRESS_FILE
from cleargs.progress import COMPILING, LineReporter, SilentReporter
from cleargs.splat.state import save_state


def test_an_active_run_is_visible_until_it_ends(bench: Bench, capsys: pytest.CaptureFixture[str]) -> None:
    hold = bench.root / "hold"
    hold.touch()
    assert running_stage(bench.folder, bench.store) is None
    process = start(bench, f"square.hold={hold}")
    wait_for(bench, "held")
    found = running_stage(bench.folder, bench.store)
    assert found is not None and (found.stage, found.label) == ("square", "square")
    work = bench.store / "work" / found.work
    assert preview_of(found, bench.store) is None
    (work / "checkpoints" / "deep").mkdir()
    (work / "checkpoints" / "preview.png").write_bytes(b"old")
    (work / "checkpoints" / "deep" / "preview.png").write_bytes(b"new")
    (work / "checkpoints" / "elsewhere").mkdir()
    (work / "checkpoints" / "elsewhere" / "preview.png").symlink_to("/etc/passwd")
    preview = preview_of(found, bench.store)
    assert preview is not None and preview.path.read_bytes() == b"new"
    assert invoke(["show", str(bench.folder)], bench.dag) == 0
    said = capsys.readouterr().out
    assert "square is running: square" in said and f"preview: {preview.path}" in said
    assert invoke(["status", str(bench.folder)], bench.dag) == 0
    (line,) = [line for line in capsys.readouterr().out.splitlines() if line.startswith("square ")]
    assert line.split()[1] == "running" and "missing" not in line
    hold.unlink()
    assert process.wait(60) == 0
    assert running_stage(bench.folder, bench.store) is None and not (bench.folder / PROGRESS_FILE).exists()


def test_a_killed_run_is_not_active(bench: Bench, capsys: pytest.CaptureFixture[str]) -> None:
    hold = bench.root / "hold"
    hold.touch()
    process = start(bench, f"square.hold={hold}")
    wait_for(bench, "held")
    process.kill()
    process.wait()
    assert (bench.folder / PROGRESS_FILE).exists() and running_stage(bench.folder, bench.store) is None
    assert stage_at_work(bench.folder, bench.store) == (
        "square",
        "interrupted at square; continues from its last checkpoint",
    )
    assert invoke(["status", str(bench.folder)], bench.dag) == 0
    assert "interrupted at square; continues from its last checkpoint" in capsys.readouterr().out
    hold.unlink()
    assert [outcome.how for outcome in bench.run()] == ["found", "made", "made"]
    assert not (bench.folder / PROGRESS_FILE).exists()


@pytest.mark.parametrize(
    "change",
    [
        {"work": "../../outside"},
        {"work": 3},
        {"done": "x"},
        {"total": [1]},
        {"seconds_left": "x"},
        {"more": 1},
    ],
)
def test_a_damaged_progress_file_is_ignored(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, change: dict[str, Any]
) -> None:
    monkeypatch.setattr(live, "writer_is_alive", lambda work: True)
    whole = RunningStage(stage="g0", work="key@host-1", label="G0", done=1, total=2).model_dump()
    (tmp_path / PROGRESS_FILE).write_text(json.dumps(whole))
    assert running_stage(tmp_path, tmp_path) is not None
    (tmp_path / PROGRESS_FILE).write_text(json.dumps(whole | change))
    assert running_stage(tmp_path, tmp_path) is None
    (tmp_path / PROGRESS_FILE).write_text("{")
    assert running_stage(tmp_path, tmp_path) is None


def test_the_task_that_advanced_last_is_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live, "WRITE_INTERVAL_S", 0.0)
    now = [0.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    with recorded_progress(SilentReporter(), tmp_path, "g0", tmp_path / "key@me") as reporter:

        def note() -> dict[str, Any]:
            found: dict[str, Any] = json.loads((tmp_path / PROGRESS_FILE).read_text())
            return found

        assert note()["stage"] == note()["label"] == "g0" and note()["work"] == "key@me"
        with reporter.task("G0", total=100) as outer:
            now[0] = 50.0  # before the first step kernels are compiled
            outer.update(done=10, note="20 dB")
            now[0] = 55.0
            outer.update(done=20)
            expected = {"label": "G0", "done": 20, "total": 100, "note": "20 dB", "seconds_left": 40.0}
            assert expected.items() <= note().items()
            with reporter.task("inner") as inner:
                inner.advance(3)
                assert (note()["label"], note()["done"], note()["total"]) == ("inner", 3, None)
            outer.advance()
            assert (note()["label"], note()["done"]) == ("G0", 21)
    assert not (tmp_path / PROGRESS_FILE).exists()


def test_the_seconds_of_compiling_are_counted_apart(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    now = [0.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    with recorded_progress(SilentReporter(), tmp_path, "g0", tmp_path / "key@me") as reporter:
        for label, seconds in (("G0", 5.0), (COMPILING, 30.0), ("G0", 7.0)):
            with reporter.task(label):
                now[0] += seconds
        assert reporter.compile_seconds == 30.0


def test_an_unwritable_progress_file_stops_nothing(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(path: Path, value: Any) -> None:
        raise StoreError("no space left", hint="")

    monkeypatch.setattr(live, "write_json", full)
    assert [outcome.how for outcome in bench.run()] == ["made"] * 3


def test_the_progress_file_is_not_in_the_work_folder(bench: Bench) -> None:
    hold = bench.root / "hold"
    hold.touch()
    process = start(bench, f"square.hold={hold}")
    wait_for(bench, "held")
    files = {file.name for file in (bench.store / "work").rglob("*") if file.is_file()}
    assert PROGRESS_FILE not in files and "state.txt" in files
    hold.unlink()
    assert process.wait(60) == 0


def test_an_interrupted_task_stays_visible(tmp_path: Path) -> None:
    work = tmp_path / "store" / "work" / "key"
    (work / "checkpoints").mkdir(parents=True)
    checkpoint = work / "checkpoints" / "g0.safetensors"
    checkpoint.touch()  # a damaged one
    lines: list[str] = []
    reporter = LineReporter(lines.append, lines.append, lambda line: None)
    with (
        pytest.raises(KeyboardInterrupt),
        recorded_progress(reporter, tmp_path, "g0", work) as recorder,
        recorder.task("G0", 800) as task,
    ):
        task.update(done=130, note="24.1 dB")
        raise KeyboardInterrupt
    assert lines == ["g0: interrupted at G0, 130 of 800, 24.1 dB; continues from its last checkpoint"]
    assert stage_at_work(tmp_path, tmp_path / "store") == tuple(lines[0].split(": ", 1))
    for write, said in (
        (lambda: save_state(checkpoint, {"step": torch.tensor(100)}), "checkpoint at 100"),
        (lambda: save_state(checkpoint, {"step": torch.tensor(130)}), "checkpoint at 130"),
        (checkpoint.unlink, "no checkpoint yet"),
    ):
        write()
        assert stage_at_work(tmp_path, tmp_path / "store") == (
            "g0",
            f"interrupted at G0, 130 of 800, 24.1 dB; {said}",
        )
