"""Densification: splits preserve the render, growth has a budget, and noise moves transparent Gaussians."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from cleargs.splat.backend import set_threads
from cleargs.splat.densification import (
    CONTRAST_FLOOR,
    refine,
    relative_error,
    rotation_matrices,
    sample_once,
    sigmoid,
)
from cleargs.splat.gaussians import Gaussians
from cleargs.splat.kernels.cpu.backend import add_position_noise

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


def refined(
    made: dict[str, np.ndarray], errors: np.ndarray, *, rate: float = 0.05, budget: int = 1000
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Return arrays after a refinement, and their moments, which were 1 before."""
    grown, (moments,) = refine(
        made,
        [{name: np.ones_like(array) for name, array in made.items()}],
        errors=errors,
        rate=rate,
        budget=budget,
        min_opacity=OPEN,
        rng=np.random.default_rng(1),
    )
    return grown, moments


def test_dead_gaussians_become_halves_of_those_with_errors() -> None:
    made = arrays(50, np.random.default_rng(0))
    dead = [3, 7, 49]
    made["logit_opacities"][dead] = -9.0
    made["logit_opacities"][7] = np.nan
    before = {name: array.copy() for name, array in made.items()}
    errors = np.zeros(50)
    errors[[*dead, 10, 20, 30]] = 1.0  # errors of dead Gaussians do not count
    grown, moments = refined(made, errors, rate=0.0)
    touched = [*dead, 10, 20, 30]
    same = np.setdiff1d(np.arange(50), touched)
    for name, array in grown.items():
        assert np.array_equal(array[same], before[name][same]), name
        assert (moments[name][same] == 1).all() and not moments[name][touched].any(), name
    sh = grown["sh"][touched]
    assert {tuple(row.ravel()) for row in sh} == {tuple(row.ravel()) for row in before["sh"][[10, 20, 30]]}
    assert (sigmoid(grown["logit_opacities"]) > OPEN).all()
    assert (grown["logit_opacities"][[10, 20, 30]] < before["logit_opacities"][[10, 20, 30]]).all()


def test_an_error_in_texture_of_low_contrast_counts_more() -> None:
    """Two textures of which half of the contrast is missing: without the floor they would count alike."""
    contrast = torch.full((40, 80, 1), 0.02)
    contrast[:, 40:] = 0.4
    target = 0.5 + contrast * (torch.rand(40, 80, 3, generator=torch.Generator().manual_seed(0)) - 0.5)
    image = 0.5 + 0.5 * (target - 0.5)
    relative, plain = relative_error(image, target, None), (image - target).square()
    soft, hard = np.s_[:, :30], np.s_[:, 50:]  # windows that see one texture only
    assert plain[hard].mean() / plain[soft].mean() == pytest.approx(400.0, rel=0.05)
    # The textures' variances are 0.02² / 12 and 0.4² / 12. 0.02 would be counted 400 times too little.
    expected = 400.0 * (0.02**2 / 12 + CONTRAST_FLOOR) / (0.4**2 / 12 + CONTRAST_FLOOR)
    assert relative[hard].mean() / relative[soft].mean() == pytest.approx(expected, rel=0.05)
    constant = torch.full((20, 20, 3), 0.3)
    even = relative_error(constant + 0.1, constant, None)
    assert even.flatten().tolist() == pytest.approx([0.1**2 / CONTRAST_FLOOR] * 1200, rel=1e-3)


def test_masked_pixels_do_not_change_relative_errors() -> None:
    """A bright thing behind a mask has no error, and gives its neighbours no contrast."""
    target = torch.rand(30, 40, 3, generator=torch.Generator().manual_seed(0))
    mask = torch.ones(30, 40, dtype=torch.bool)
    mask[10:20, 10:20] = False
    changed = target.masked_fill(~mask[..., None], 5.0)
    found = relative_error(target + 0.1, changed, mask)
    torch.testing.assert_close(found, relative_error(target + 0.1, target, mask), rtol=0, atol=0)
    assert (found[~mask] == 0.0).all() and (found[mask] > 0.0).all()
    nothing = relative_error(target, changed, torch.zeros_like(mask))
    assert (nothing == 0.0).all()


@pytest.mark.parametrize("threads", [2, 3])
def test_relative_errors_do_not_depend_on_threads(threads: int) -> None:
    images = torch.rand(2, 97, 131, 3, generator=torch.Generator().manual_seed(0))
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(1)
        alone = relative_error(*images, None)
        torch.set_num_threads(threads)
        assert torch.equal(relative_error(*images, None), alone)
    finally:
        torch.set_num_threads(before)


@pytest.mark.parametrize("condition", ["is alive", "has errors"])
def test_nothing_changes_if_no_gaussian(condition: str) -> None:
    made = arrays(4, np.random.default_rng(0))
    if condition == "is alive":
        made["logit_opacities"][:] = -20.0
    before = made["means"].copy()
    grown, moments = refined(made, np.full(4, float(condition == "is alive")), rate=1.0)
    assert np.array_equal(grown["means"], before) and (moments["means"] == 1).all()


@pytest.mark.parametrize(("budget", "expected"), [(1000, 105), (102, 102), (100, 100), (10, 100)])
def test_growth_stops_at_the_budget(budget: int, expected: int) -> None:
    made = arrays(100, np.random.default_rng(0))
    grown, moments = refined(made, np.ones(100), budget=budget)
    assert (
        {len(array) for array in grown.values()} == {len(array) for array in moments.values()} == {expected}
    )
    assert (moments["sh"][100:] == 0).all()
    assert all(array.dtype == np.float32 and array.flags.c_contiguous for array in grown.values())


def test_a_gaussian_with_a_large_error_is_split_repeatedly() -> None:
    """A Gaussian with all of the error becomes 2 after the first round, 4 after the second, 16 at the end."""
    made = arrays(200, np.random.default_rng(0))
    made["log_scales"][5] = 1.0
    before = {name: array.copy() for name, array in made.items()}
    grown, _ = refined(made, np.eye(200)[5], rate=0.2)
    assert len(grown["means"]) == 200 + 15
    parts = np.flatnonzero((grown["sh"] == before["sh"][5]).all(axis=(1, 2)))
    assert len(parts) == 16 and 5 in parts
    np.testing.assert_allclose(grown["means"][parts].mean(axis=0), before["means"][5], atol=1e-4)
    assert np.exp(grown["log_scales"][parts]).prod(axis=1).max() < 0.3 * np.exp(3.0)  # the volume


@given(opacity=st.floats(0.02, 0.99), seed=st.integers(0, 99))
def test_two_halves_look_like_the_whole(opacity: float, seed: int) -> None:
    made = arrays(1, np.random.default_rng(seed))
    made["logit_opacities"][0] = np.log(opacity / (1 - opacity))
    whole = {name: array[0].astype(np.float64) for name, array in made.items()}
    grown, _ = refined(made, np.ones(1), rate=1.0)
    # The halves are on opposite sides of the centre, along the longest axis.
    np.testing.assert_allclose(grown["means"].mean(axis=0), whole["means"], atol=1e-6)
    longest = whole["log_scales"].argmax()
    axis = rotation_matrices(whole["rotations"][None].astype(np.float32))[0][:, longest]
    apart = grown["means"][1] - grown["means"][0]
    assert abs(apart @ axis) == pytest.approx(np.linalg.norm(apart), rel=1e-4)
    # Mass and variance of the optical depth along that axis are preserved within 5 %. Units: its scale.
    x = np.linspace(-6, 6, 2001)
    place = np.linalg.norm(apart) / 2 / np.exp(whole["log_scales"][longest])
    scales = np.exp(grown["log_scales"][:, longest] - whole["log_scales"][longest])
    assert scales[0] == scales[1] and grown["logit_opacities"][0] == grown["logit_opacities"][1]
    depth = -np.log1p(-sigmoid(np.float64(grown["logit_opacities"][0])))
    halves = sum(depth * np.exp(-(((x - at) / scales[0]) ** 2) / 2) for at in (-place, place))
    one = -np.log1p(-opacity) * np.exp(-(x**2) / 2)
    assert halves.sum() == pytest.approx(one.sum(), rel=0.05)
    assert (halves * x**2).sum() == pytest.approx((one * x**2).sum(), rel=0.05)


def test_samples_follow_the_weights() -> None:
    weights, rng = np.array([0.0, 1.0, 3.0, 0.0]), np.random.default_rng(0)
    first = np.array([sample_once(weights, 1, rng)[0] for _ in range(10_000)])
    counts = np.bincount(first, minlength=4)
    assert counts[0] == counts[3] == 0
    # The standard deviation of the count is sqrt(10000 * 1/4 * 3/4) = 43; the limit is five of them.
    assert abs(counts[1] - 2_500) < 217
    assert set(sample_once(weights, 2, rng)) == {1, 2}


COUNT = 20_000


def noise(seed: int = 11, *, opacity: float = OPEN, threads: int = 2) -> np.ndarray:
    """Return the noise on the means [COUNT, 3] of equal Gaussians, of which the first 100 are opaque."""
    opacities = torch.full((COUNT,), float(np.log(opacity / (1 - opacity))))
    opacities[:100] = 3.0
    many = Gaussians(
        torch.zeros(COUNT, 3),
        torch.log(torch.tensor(SCALES)).repeat(COUNT, 1),
        torch.from_numpy(QUATERNION).repeat(COUNT, 1),
        opacities,
        torch.zeros(COUNT, 1, 3),
    )
    set_threads(threads)
    add_position_noise(many, amount=2.0, min_opacity=OPEN, seed=(seed,))
    return many.means.double().numpy()


SCALES = [0.1, 0.02, 0.01]
QUATERNION = np.float32([0.9, 0.1, -0.3, 0.2]) * 3


def test_noise_of_transparent_gaussians_has_their_covariance() -> None:
    offsets = noise()  # the factor of the noise is exactly 1/2
    assert not offsets[:100].any() and offsets[100:].any(axis=1).all()
    matrix = rotation_matrices(QUATERNION[None])[0].astype(np.float64)
    covariance = matrix @ np.diag(np.square(SCALES)) @ matrix.T
    draws = offsets[100:] @ np.linalg.inv(covariance)  # amount * fade = 1
    # 19,900 draws: the standard errors are 0.007 for means and correlations, 0.005 for deviations, and 0.0033
    # for the share within one standard deviation (68.27 %). The limits are four standard errors.
    np.testing.assert_allclose(draws.mean(axis=0), 0.0, atol=0.03)
    np.testing.assert_allclose(np.cov(draws.T), np.eye(3), atol=0.04)
    np.testing.assert_allclose((np.abs(draws) < 1).mean(axis=0), 0.6827, atol=0.014)


def test_noise_fades_with_opacity_and_never_repeats() -> None:
    faint, half = noise(opacity=OPEN), noise(opacity=0.05)
    # The ratio is sigmoid(-4.5) / sigmoid(0). Rounding of the logit to float32 changes it by about 1e-5.
    np.testing.assert_allclose(half, faint / (0.5 * (1 + np.exp(4.5))), rtol=1e-4, atol=1e-12)
    assert not noise(opacity=0.2).any()
    drawn = np.concatenate([faint[100:], noise(seed=12)[100:]])
    assert len(np.unique(drawn, axis=0)) == len(drawn)


def test_noise_is_the_same_for_any_number_of_threads() -> None:
    assert np.array_equal(noise(threads=1), noise(threads=2))


def test_rotations_are_rotations() -> None:
    quaternions = np.random.default_rng(0).standard_normal((20, 4)).astype(np.float32)
    quaternions[0] = 0
    matrices = rotation_matrices(quaternions).astype(np.float64)
    np.testing.assert_allclose(
        matrices @ matrices.transpose(0, 2, 1), np.tile(np.eye(3), (20, 1, 1)), atol=1e-5
    )
    np.testing.assert_allclose(np.linalg.det(matrices), 1.0, atol=1e-5)
    assert np.array_equal(matrices[0], np.eye(3))
