"""``python -m benchmarks poses``: one row per capture and error of the given cameras."""

from __future__ import annotations

import csv
from pathlib import Path

import pytest
from click.testing import CliRunner

from benchmarks import poses, poses_command
from cleargs.progress import SilentReporter
from cleargs.synth.synthetic_capture import make_capture


@pytest.mark.slow  # 12 s of a processor
def test_wrong_cameras_come_nearer_to_the_true_ones(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    make_capture(
        tmp_path / "room", "sharp", frames=12, width=240, height=180, seed=1, reporter=SilentReporter()
    )
    monkeypatch.setattr(poses, "GIVEN", {name: poses.GIVEN[name] for name in ("exact", "depth")})
    result = CliRunner().invoke(
        poses_command.poses,
        [str(tmp_path / "room"), "-o", str(tmp_path), "--size", "240"],
        catch_exceptions=False,
    )
    exact, depth = csv.DictReader(result.output.splitlines())
    assert (exact["capture"], exact["given"], depth["given"]) == ("room", "exact", "depth")
    # Depth cameras miss by some per cent of the scene's size. Both ways end at the same poses.
    assert float(exact["off_before"]) < 1e-6 < 0.01 < float(depth["off_before"])
    assert max(float(depth["off_adjusted"]), float(depth["off_sfm"])) < 0.3 * float(depth["off_before"])
