"""Exposure compensation: gains, centring and the table."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.splat_toy import HEIGHT, WIDTH, camera, keep
from numpy.typing import NDArray

from cleargs.formation.exposure import (
    IDENTITY,
    Exposure,
    centred,
    frame_gains,
    gain_spread,
    read_exposure,
    write_exposure,
)
from cleargs.splat.sparse_points import SparsePoints
from cleargs.splat.views import TrainingView

WALL = 0.2


def wall(gains: Sequence[float | NDArray[np.float64]]) -> tuple[list[TrainingView], SparsePoints]:
    """Return views of a textured wall with these gains, and points on the wall with the colours of gain 1."""
    rng = np.random.default_rng(0)
    texture = rng.uniform(60, 180, (HEIGHT, WIDTH, 3))
    eye = camera(0.0)
    rows, columns = np.divmod(rng.choice(HEIGHT * WIDTH, 200, replace=False), WIDTH)
    depth = 1.0 + WALL
    x = (columns + 0.5 - eye.cx) / eye.fx * depth
    y = (rows + 0.5 - eye.cy) / eye.fy * depth
    xyz = np.stack([x, y, np.full(200, WALL)], axis=1)  # the camera is at z = -1
    views = [
        TrainingView(index, eye, 1.0, "real", keep(np.rint(texture * gain).astype(np.uint8)))
        for index, gain in enumerate(gains)
    ]
    everything = np.arange(200)
    return views, SparsePoints(
        xyz, np.rint(texture[rows, columns]).astype(np.uint8), [everything] * len(gains)
    )


def test_gains_are_measured_on_the_points() -> None:
    gains = [1.0, 0.8, 1.3, 1.0]
    measured = frame_gains(*wall(gains))
    # Pixels are integers between 48 and 234, three are summed, and the median is taken: the error is below
    # 0.5 %.
    np.testing.assert_allclose(measured, np.array(gains)[:, None].repeat(3, axis=1), rtol=6e-3)
    brightness, colour = gain_spread(measured)
    assert brightness == pytest.approx(np.log(gains).std(), rel=0.02) and colour < 0.005
    assert max(gain_spread(frame_gains(*wall([1.0, 1.0, 1.0])))) < 0.002


def test_a_white_balance_spreads_the_colours_and_not_the_brightness() -> None:
    cold, warm = [0.85, 1.0, 1.15], [1.15, 1.0, 0.85]
    gains = frame_gains(*wall([np.array(cold), np.array(warm)] * 2))
    brightness, colour = gain_spread(gains)
    assert brightness < 0.01 and colour == pytest.approx(0.15, abs=0.01)
    start = Exposure.from_gains([0, 1, 2, 3], gains)
    np.testing.assert_allclose(
        start.of(0)[:, :3] / start.of(1)[:, :3].diagonal(), np.diag(cold) / warm, rtol=0.02
    )


def test_masked_and_invisible_points_do_not_count() -> None:
    views, sparse = wall([1.0])
    nothing = replace(views[0], load=keep(views[0].load()[0], np.zeros((HEIGHT, WIDTH), np.bool_)))
    assert np.isnan(frame_gains([nothing], sparse)).all()
    behind = replace(sparse, xyz=sparse.xyz * [1, 1, -20])
    assert np.isnan(frame_gains(views, behind)).all()
    assert gain_spread(np.full((1, 3), np.nan)) == (0.0, 0.0)


def test_the_weighted_median_is_the_identity() -> None:
    rng = np.random.default_rng(0)
    weights = np.array([1.0, 0.12, 0.0, 0.9, 0.3])
    moved = centred(IDENTITY + 0.1 * rng.standard_normal((5, 3, 4)), weights)
    below = np.einsum("f,fij->ij", weights, moved <= IDENTITY)
    above = np.einsum("f,fij->ij", weights, moved >= IDENTITY)
    assert (below >= weights.sum() / 2).all() and (above >= weights.sum() / 2).all()
    untouched = IDENTITY + rng.standard_normal((2, 3, 4))
    assert np.array_equal(centred(untouched, np.zeros(2)), untouched)


def test_a_few_dark_frames_do_not_move_the_others() -> None:
    """With the mean as reference, two dark frames out of ten made the scene 10 % too dark."""
    gains = np.array([0.5, 1.0, 1.01, 0.99, np.nan, 1.0, 0.5, 1.0, 1.02, 0.98])[:, None].repeat(3, axis=1)
    frame_ids = [9, 8, 7, 6, 5, 4, 3, 2, 1, 0]
    start = Exposure.from_gains(frame_ids, gains)
    assert start.frame_ids.tolist() == list(range(10))
    assert np.array_equal(start.of(5), IDENTITY), "a frame of unknown gain starts from the identity"
    np.testing.assert_allclose(start.of(9), 0.5 * IDENTITY)
    settled = Exposure(start.frame_ids, centred(start.affines, np.ones(10)))
    np.testing.assert_allclose(settled.of(8), IDENTITY, atol=1e-12)


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
