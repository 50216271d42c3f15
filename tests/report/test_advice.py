"""The advice of a report: commands that run as they are printed, the most useful first."""

from __future__ import annotations

import re
import shlex
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from report_run import FinishedRun

from cleargs.cli.main import invoke
from cleargs.digest import DigestMemo
from cleargs.pipeline.config import load_config
from cleargs.pipeline.plan import Planner
from cleargs.pipeline.run_file import RunSpec, write_run_file
from cleargs.pipeline.stages import installed
from cleargs.pipeline.store import Store
from cleargs.progress import SilentReporter
from cleargs.report.advice import Advice, shown_advice
from cleargs.report.frames import FrameRow, load_rows
from cleargs.report.outcome import outcome
from cleargs.report.report_json import linked_manifests

SIZE = 64


def advice(tmp_path: Path, rows: Any, manifests: Any, *settings: str) -> list[Advice]:
    """Advice on a run with these settings, whose capture does not exist."""
    config = load_config(installed(), "default", settings)
    run = RunSpec(tmp_path / "run", tmp_path / "clip.mp4", config, tmp_path / "store", "cpu")
    with DigestMemo(tmp_path / "digests.json") as memo:
        planner = Planner(installed(), run, Store(tmp_path, memo), 1, SilentReporter())
        return shown_advice(planner, manifests, rows)


def frame(role: str = "strong", **values: Any) -> FrameRow:
    """A placed frame; ``role``: also "lost" or "held out"."""
    facts = {"registered": role != "lost", "split": "test" if role == "held out" else "train"}
    return FrameRow(SimpleNamespace(width=SIZE, height=48, **facts), {"role": role, "weight": 1.0, **values})  # type: ignore[arg-type]


def ingest(available: int) -> Any:
    return {"ingest": SimpleNamespace(summary={"frames_available": available}, missing=())}


def test_advice_is_only_what_can_help(tmp_path: Path) -> None:
    def first(frames: int, available: int, *settings: str) -> str:
        found = advice(tmp_path, [frame("lost")] * frames, ingest(available), *settings)
        return found[0].command.partition("-o run")[2].strip()

    assert first(40, 40) == ""  # every frame is used, and compared with every other
    assert first(40, 60) == "--set ingest.max_frames=60"
    assert first(40, 60, "ingest.fps=2") == "--set ingest.fps=4.0"
    assert first(40, 40, "ingest.fps=2") == ""  # images have no rate
    assert first(150, 400) == "--set ingest.max_frames=300 --set ingest.overlap=16"


def test_a_draft_gets_no_advice_that_it_does_not_follow(tmp_path: Path) -> None:
    """A draft takes 60 frames, whatever the setting is: a command for more of them did nothing."""
    found = advice(tmp_path, [frame() for _ in range(60)], ingest(120), "g0.quality=draft")
    assert not any("ingest.max_frames" in shown.command for shown in found)
    found = advice(tmp_path, [frame("lost")] * 60, ingest(120), "g0.quality=draft")
    assert not any("ingest.max_frames" in shown.command for shown in found)


def test_holding_out_frames_is_never_the_only_command(tmp_path: Path) -> None:
    rows = [frame() for _ in range(40)]
    assert advice(tmp_path, rows, ingest(40)) == [], "nothing is wrong"
    found = advice(tmp_path, rows, ingest(100))
    assert [shown.command.split()[-1] for shown in found] == [
        "ingest.max_frames=80",
        "ingest.holdout=every:8",
    ]
    held = advice(tmp_path, [*rows, frame("held out")], ingest(100))
    assert [shown.command.split()[-1] for shown in held] == ["ingest.max_frames=82"]


@pytest.mark.parametrize(
    ("steps", "settings", "options"),
    [
        (800, ["g0.quality=draft"], "--quality standard"),
        (3200, [], "--quality high"),
        (400, ["g0.steps=400", "rva.tau_R=0.6"], "--reset --set rva.tau_R=0.6 --quality standard"),
    ],
)
def test_a_short_training_gets_the_command_for_a_longer_one(
    tmp_path: Path, steps: int, settings: list[str], options: str
) -> None:
    manifests = ingest(40) | {"g0": SimpleNamespace(summary={"steps": steps, "exposure": True}, missing=())}
    found = advice(tmp_path, [frame() for _ in range(40)], manifests, *settings)
    assert found[0].command == f"cleargs run clip.mp4 -o run {options}" and " dB" in found[0].gain
    worths = [shown.worth for shown in found]
    assert worths == sorted(worths, reverse=True)


@pytest.mark.parametrize("figure", ["exposure_spread", "colour_spread"])
@pytest.mark.parametrize(
    ("spread", "on", "advised"), [(0.2, False, True), (0.2, True, False), (0.0, False, False)]
)
def test_colours_that_differ_get_exposure_compensation(
    tmp_path: Path, figure: str, spread: float, on: bool, advised: bool
) -> None:
    facts = {"steps": 3200, "exposure": on, figure: spread}
    manifests = ingest(40) | {"g0": SimpleNamespace(summary=facts, missing=())}
    found = advice(tmp_path, [frame() for _ in range(40)], manifests)
    assert any(shown.command.endswith("--set g0.exposure=on") for shown in found) is advised


def test_printed_commands_run_as_printed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(Planner, "pace_of", lambda self, made: 1.0)  # the fixture took no time
    finished = FinishedRun(tmp_path)
    (tmp_path / "my capture").mkdir()
    for k in range(4):
        image = np.full((480, 10 * SIZE, 3), 40 * k, np.uint8)
        cv2.imwrite(str(tmp_path / f"my capture/{k}.png"), image)
    run = replace(finished.run, source=tmp_path / "my capture")
    manifests = linked_manifests(finished.folder, finished.dag.names)
    with DigestMemo(tmp_path / "digests.json") as memo:
        planner = Planner(finished.dag, run, Store(tmp_path, memo), 1, SilentReporter())
        found = shown_advice(planner, manifests, load_rows(finished.folder, manifests))
    commands = [shown for shown in found if shown.command]
    assert commands[0].command == (
        "cleargs run 'my capture' -o run --reset --set rva.tau_R=0.61 --quality standard"
    )
    assert len(commands) >= 2 and commands[-1].command.endswith("--set ingest.holdout=every:8")
    minutes = [int(re.fullmatch(r"about (\d+) min", shown.time)[1]) for shown in commands]
    assert minutes[0] > minutes[-1] >= 1, "the settings of the command decide, not those of the run"
    monkeypatch.chdir(tmp_path)
    write_run_file(run)  # the capture of the run
    for shown in commands:
        program, *words = shlex.split(shown.command)
        assert program == "cleargs" and invoke([*words, "--dry-run"], finished.dag) == 0, (
            capsys.readouterr().err
        )


def test_the_verdict_names_the_capture_and_a_short_training() -> None:
    def headline(steps: int, time_s: float | None) -> str:
        facts = {"registered": True, "split": "train", "time_s": time_s}
        rows = [FrameRow(SimpleNamespace(**facts), {"role": "strong", "weight": 1.0})] * 40  # type: ignore[arg-type]
        g0 = SimpleNamespace(summary={"psnr_unseen": 32.4, "steps": steps})
        return outcome({"g0": g0}, rows, []).headline  # type: ignore[dict-item]

    assert headline(40, None) == "Good: the scene matches the photographs closely after a short training."
    assert headline(10_000, 0.1) == "Good: the scene matches the video closely."


def test_a_draft_has_no_stages_for_repairs(tmp_path: Path) -> None:
    def stages(*settings: str) -> tuple[str, ...]:
        config = load_config(installed(), "default", settings)
        return RunSpec(tmp_path, tmp_path, config, tmp_path, "cpu").stages(installed())

    assert stages("g0.quality=draft") == ("ingest", "rva", "g0") and len(stages()) == 5
