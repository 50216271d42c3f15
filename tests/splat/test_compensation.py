"""When exposure compensation is on, and what its table keeps."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from splat_toy import HEIGHT, WIDTH, camera, keep

from cleargs.splat.compensation import (
    IDENTITY,
    Exposure,
    centred,
    frame_gains,
    gain_spread,
    read_exposure,
    write_exposure,
)
from cleargs.splat.initialise import SparsePoints
from cleargs.splat.views import View

WALL = 0.2


def wall(gains: list[float]) -> tuple[list[View], SparsePoints]:
    """Views of one textured wall, each with its gain, and the points on the wall at the colours of gain 1."""
    rng = np.random.default_rng(0)
    texture = rng.uniform(60, 180, (HEIGHT, WIDTH, 3))
    eye = camera(0.0)
    rows, columns = np.divmod(rng.choice(HEIGHT * WIDTH, 200, replace=False), WIDTH)
    depth = 1.0 + WALL
    x = (columns + 0.5 - eye.cx) / eye.fx * depth
    y = (rows + 0.5 - eye.cy) / eye.fy * depth
    xyz = np.stack([x, y, np.full(200, WALL)], axis=1)  # the camera stands at z = -1
    views = [
        View(index, eye, 1.0, "real", keep(np.rint(texture * gain).astype(np.uint8)))
        for index, gain in enumerate(gains)
    ]
    everything = np.arange(200)
    return views, SparsePoints(
        xyz, np.rint(texture[rows, columns]).astype(np.uint8), [everything] * len(gains)
    )


def test_gains_are_measured_on_the_points() -> None:
    gains = [1.0, 0.8, 1.3, 1.0]
    measured = frame_gains(*wall(gains))
    # Pixels are whole levels between 48 and 234, three are summed, and a median is taken: under 0.5 %.
    np.testing.assert_allclose(measured, gains, rtol=5e-3)
    assert gain_spread(measured) == pytest.approx(np.log(gains).std(), rel=0.02)
    assert gain_spread(frame_gains(*wall([1.0, 1.0, 1.0]))) < 0.002


def test_masked_points_and_points_out_of_sight_do_not_count() -> None:
    views, sparse = wall([1.0])
    nothing = replace(views[0], load=keep(views[0].load()[0], np.zeros((HEIGHT, WIDTH), np.bool_)))
    assert np.isnan(frame_gains([nothing], sparse)).all()
    behind = replace(sparse, xyz=sparse.xyz * [1, 1, -20])
    assert np.isnan(frame_gains(views, behind)).all()
    assert gain_spread(np.array([np.nan])) == 0.0


def test_the_weighted_mean_is_the_identity() -> None:
    rng = np.random.default_rng(0)
    weights = np.array([1.0, 0.12, 0.0, 0.9])
    moved = centred(IDENTITY + 0.1 * rng.standard_normal((4, 3, 4)), weights)
    np.testing.assert_allclose(np.einsum("f,fij->ij", weights, moved) / weights.sum(), IDENTITY, atol=1e-15)
    untouched = IDENTITY + rng.standard_normal((2, 3, 4))
    assert np.array_equal(centred(untouched, np.zeros(2)), untouched)


def test_the_table_keeps_every_bit(tmp_path: Path) -> None:
    off = Exposure.identity([4, 2, 9])
    assert not off.enabled
    assert off.frame_ids.tolist() == [2, 4, 9]
    on = Exposure(off.frame_ids, off.affines + np.random.default_rng(0).standard_normal((3, 3, 4)))
    assert on.enabled
    write_exposure(tmp_path / "exposure.parquet", on)
    back = read_exposure(tmp_path / "exposure.parquet")
    assert np.array_equal(back.affines, on.affines)
    assert np.array_equal(back.frame_ids, on.frame_ids)
    assert np.array_equal(back.of(4), on.affines[1])
    assert np.array_equal(back.of(5), IDENTITY)
