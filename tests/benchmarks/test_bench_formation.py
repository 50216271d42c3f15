"""The benchmark of image formation: its methods, their gradients and its command."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from benchmarks.commands import invoke
from benchmarks.speed.formation_cost import (
    FORMED,
    PLAIN,
    FormationPlan,
    _MeanOfRenders,
    motion_of,
    poses_along,
    run,
)
from benchmarks.speed.random_scenes import surface_scene
from cleargs.progress import SilentReporter
from cleargs.splat.backend import rasteriser_for


@pytest.mark.slow
def test_more_renders_are_closer_to_the_exposure() -> None:
    plan = FormationPlan(2_000, 96, 54, (4.0,), (3, 9), 1, rounds=1, repetitions=1)
    (row,) = run(plan, SilentReporter()).rows
    assert set(row.times) == {PLAIN, FORMED, "3 renders", "9 renders"}
    assert row.ratio[PLAIN].median == 1.0
    # Measured: 26, 33, 38 and 47 dB.
    assert row.psnr[PLAIN] + 3 < row.psnr[FORMED]
    assert row.psnr[PLAIN] + 3 < row.psnr["3 renders"] < row.psnr["9 renders"] - 3


def test_mean_of_renders_matches_finite_differences() -> None:
    gaussians, camera = surface_scene(400, 48, 27)
    step = _MeanOfRenders(gaussians, camera, motion_of(3.0, 5.0), 3)
    weight = torch.from_numpy(np.random.default_rng(0).normal(size=(27, 48, 3)).astype(np.float32))
    step.image()
    found = step.backward(weight).sh[:, 0].double().clone()
    moved = torch.from_numpy(np.random.default_rng(1).normal(size=found.shape))

    def value(by: float) -> float:
        kept = step.gaussians.sh.clone()
        step.gaussians.sh[:, 0] += (by * moved).float()
        image = step.image()
        step.gaussians.sh.copy_(kept)
        return float((image.double() * weight).sum())

    slope = (value(1e-3) - value(-1e-3)) / 2e-3
    # The weighted sum over a float32 image of 4,000 numbers has a relative error of about 1e-5.
    assert slope == pytest.approx(float((found * moved).sum()), rel=2e-2)


def test_path_is_centred_on_the_pose() -> None:
    gaussians, camera = surface_scene(400, 48, 27)
    motion = motion_of(6.0, 5.0)
    (middle,) = poses_along(camera, motion, 1)
    np.testing.assert_allclose(middle.world_to_camera, camera.world_to_camera, atol=1e-12)
    first, last = poses_along(camera, motion, 2)
    assert not np.allclose(first.world_to_camera, last.world_to_camera)
    assert rasteriser_for().forward(gaussians, first).image.isfinite().all()


@pytest.mark.slow
def test_command_writes_table_picture_and_json(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert invoke(["formation", "--quick", "--threads", "1", "-o", str(tmp_path), "--json"]) == 0
    values = json.loads(capsys.readouterr().out)
    assert [row["length"] for row in values["rows"]] == [3.0, 10.0]
    assert json.loads((tmp_path / "formation.json").read_text()) == values
    assert (tmp_path / "formation.png").read_bytes().startswith(b"\x89PNG")
    assert "| 9 renders |" in (tmp_path / "formation.md").read_text()
