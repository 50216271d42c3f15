"""Densification: what is copied looks as before, budgets hold, noise goes where it should."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cleargs.splat.strategy.mcmc import (
    grow,
    mean_noise,
    relocate,
    rotation_matrices,
    sample,
    sigmoid,
    split_opacity,
)

OPEN = 0.005


def arrays(count: int, rng: np.random.Generator) -> dict[str, np.ndarray]:
    made = {
        "means": rng.standard_normal((count, 3)),
        "log_scales": rng.uniform(-4, -2, (count, 3)),
        "rotations": rng.standard_normal((count, 4)),
        "logit_opacities": rng.uniform(-2, 3, count),
        "sh": rng.standard_normal((count, 4, 3)),
    }
    return {name: array.astype(np.float32) for name, array in made.items()}


@given(opacity=st.floats(0.006, 0.95), copies=st.integers(1, 12))
def test_split_gaussians_hold_the_opacity_of_one(opacity: float, copies: int) -> None:
    split, factor = split_opacity(np.array([opacity]), np.array([copies]))
    # Stacked at one place they let through what the one let through.
    assert (1 - split[0]) ** copies == pytest.approx(1 - opacity, rel=1e-9)
    assert factor[0] <= 1.0 + 1e-9
    if copies == 1:
        assert factor[0] == pytest.approx(1.0)
    # Equation 9 keeps the integral over a line through the centre of the composed alpha.
    x = np.linspace(-8, 8, 4001)
    before = opacity * np.exp(-(x**2) / 2)
    after = 1 - (1 - split[0] * np.exp(-((x / factor[0]) ** 2) / 2)) ** copies
    assert after.sum() == pytest.approx(before.sum(), rel=1e-4)


def test_relocation_moves_the_dead_only() -> None:
    rng = np.random.default_rng(0)
    made = arrays(50, rng)
    dead = np.array([3, 7, 49])
    made["logit_opacities"][dead] = -9.0
    made["logit_opacities"][7] = np.nan
    before = {name: array.copy() for name, array in made.items()}
    moments = [{name: np.ones_like(array) for name, array in made.items()} for _ in range(2)]
    assert relocate(made, moments, min_opacity=OPEN, rng=np.random.default_rng(1)) == 3
    sources = [
        int(np.flatnonzero((before["means"] == made["means"][index]).all(axis=1))[0]) for index in dead
    ]
    assert not set(sources) & set(dead.tolist())
    touched = np.zeros(50, np.bool_)
    touched[[*dead, *sources]] = True
    for name, array in made.items():
        assert np.array_equal(array[~touched], before[name][~touched]), name
        assert np.array_equal(array[dead], array[sources]), name
        for moment in moments:
            assert (moment[name][touched] == 0).all()
            assert (moment[name][~touched] == 1).all()
    assert (made["logit_opacities"][sources] < before["logit_opacities"][sources]).all()
    assert (sigmoid(made["logit_opacities"]) > OPEN).all()


def test_relocation_with_nobody_alive_changes_nothing() -> None:
    made = arrays(4, np.random.default_rng(0))
    made["logit_opacities"][:] = -20.0
    before = made["means"].copy()
    assert relocate(made, [], min_opacity=OPEN, rng=np.random.default_rng(1)) == 0
    assert np.array_equal(made["means"], before)


@pytest.mark.parametrize(("budget", "expected"), [(1000, 105), (102, 102), (100, 100), (10, 100)])
def test_growth_stops_at_the_budget(budget: int, expected: int) -> None:
    made = arrays(100, np.random.default_rng(0))
    moments = [{name: np.ones_like(array) for name, array in made.items()}]
    grown, reset_moments = grow(
        made, moments, rate=0.05, budget=budget, min_opacity=OPEN, rng=np.random.default_rng(1)
    )
    assert {len(array) for array in grown.values()} == {expected}
    assert {len(array) for array in reset_moments[0].values()} == {expected}
    assert (reset_moments[0]["sh"][100:] == 0).all()
    assert all(array.dtype == np.float32 and array.flags.c_contiguous for array in grown.values())


def test_samples_follow_the_weights() -> None:
    drawn = sample(np.array([0.0, 1.0, 3.0, 0.0]), 40_000, np.random.default_rng(0))
    counts = np.bincount(drawn, minlength=4)
    assert counts[0] == counts[3] == 0
    # Standard deviation of the count is sqrt(40000 * 1/4 * 3/4) = 87; five of them.
    assert abs(counts[1] - 10_000) < 435


def test_noise_is_the_covariance_times_normal_where_transparent() -> None:
    rng = np.random.default_rng(0)
    count = 20_000
    log_scales = np.tile(np.log(np.float32([0.1, 0.02, 0.01])), (count, 1))
    quaternion = np.float32([0.9, 0.1, -0.3, 0.2]) * 3
    rotations = np.tile(quaternion, (count, 1))
    opacities = np.full(count, np.log(OPEN / (1 - OPEN)), np.float32)  # the sigmoid fades to exactly a half
    opacities[:100] = 3.0
    felt, offsets = mean_noise(log_scales, rotations, opacities, amount=2.0, min_opacity=OPEN, rng=rng)
    assert np.array_equal(felt, np.arange(100, count))
    matrix = rotation_matrices(quaternion[None])[0].astype(np.float64)
    covariance = matrix @ np.diag(np.float64([0.1, 0.02, 0.01]) ** 2) @ matrix.T
    expected = covariance @ covariance.T  # amount * fade = 1
    measured = offsets.T.astype(np.float64) @ offsets / len(offsets)
    # Relative spread of a sample covariance of 20,000 draws is about 1 %; five of them of the largest entry.
    np.testing.assert_allclose(measured, expected, atol=0.05 * expected.max())


def test_rotations_are_rotations() -> None:
    quaternions = np.random.default_rng(0).standard_normal((20, 4)).astype(np.float32)
    quaternions[0] = 0
    matrices = rotation_matrices(quaternions).astype(np.float64)
    np.testing.assert_allclose(
        matrices @ matrices.transpose(0, 2, 1), np.tile(np.eye(3), (20, 1, 1)), atol=1e-5
    )
    np.testing.assert_allclose(np.linalg.det(matrices), 1.0, atol=1e-5)
    assert np.array_equal(matrices[0], np.eye(3))
