"""Motion and readout time that ingest measures in the videos of rooms, against the true ones."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from benchmarks.motion import compare
from cleargs.cli.main import invoke
from cleargs.manifest import read_manifest
from cleargs.pipeline.stages import installed


def filmed(folder: Path, protocol: str) -> Path:
    room = folder / protocol
    arguments = ["--protocol", protocol, "--frames", "16", "--size", "240x136", "--seed", "31", "--video"]
    assert invoke(["synth", str(room), *arguments], installed()) == 0
    return room


def ingested(room: Path, run: Path, *more: str, threads: int = 2) -> dict[str, Any]:
    arguments = ["--max-frames", "16", "--until", "ingest", "--no-report", "--threads", str(threads), *more]
    assert invoke(["run", str(room / "capture.mp4"), "-o", str(run), *arguments], installed()) == 0
    return dict(read_manifest(run / "ingest").summary)


@pytest.mark.slow
def test_a_rolling_shutter_and_the_motion_of_a_room_are_measured(tmp_path: Path) -> None:
    """Poses are from SfM. Observed: 27 % of the motion remains, and the readout is 1 % off."""
    room = filmed(tmp_path, "phone")
    summary = ingested(room, tmp_path / "run")
    row = compare(room, tmp_path / "run").row()
    assert row["frames"] >= 12
    assert row["left_by_neighbours"] < 0.35 < 0.6 < row["left_by_chosen_frames"]
    true_ms = 1000 * row["readout_true"] / 30
    assert summary["readout_ms"] == pytest.approx(true_ms, rel=0.1)
    low, high = summary["readout_interval_ms"]
    assert low < true_ms < high and summary["readout_along"] == "rows"
    other = ingested(room, tmp_path / "again", threads=1)
    assert json.dumps(other, sort_keys=True) == json.dumps(summary, sort_keys=True)
    files = [read_manifest(tmp_path / run / "ingest").files for run in ("run", "again")]
    assert files[0] == files[1]
    still = ingested(room, tmp_path / "still", "--set", "ingest.rolling_shutter=false")
    assert still["readout_ms"] is None and still["motion"] == summary["motion"]
    assert still["registered"] == summary["registered"]


@pytest.mark.slow
def test_a_sharp_room_has_no_readout(tmp_path: Path) -> None:
    summary = ingested(filmed(tmp_path, "sharp"), tmp_path / "run")
    assert summary["readout_ms"] is None and summary["readout_interval_ms"] is None
    assert summary["motion"] == {"measured": 16}
