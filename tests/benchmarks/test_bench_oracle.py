"""The errors against the oracle: exact on the chosen pixels, and equal to a planted error."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from benchmarks.speed import oracle as oracle_module
from benchmarks.speed import reference
from benchmarks.speed.iteration import Iteration
from benchmarks.speed.oracle import (
    Truth,
    accuracy,
    choose_pixels,
    gradient_error,
    oracle,
    pixel_centres,
    seen_at,
)
from cleargs.splat import constants
from cleargs.splat.camera import Camera
from cleargs.splat.gaussians import Gaussians
from cleargs.splat.random_scene import random_scene

SPLATS, WIDTH, HEIGHT = 90, 45, 33
PIXELS = torch.tensor([3, 47, 500, 501, 733, 1200, 1484])


@pytest.fixture(scope="module")
def scene() -> tuple[Gaussians, Camera]:
    return random_scene(SPLATS, WIDTH, HEIGHT)


@pytest.fixture(scope="module")
def truth(scene: tuple[Gaussians, Camera]) -> Truth:
    return oracle(*scene, PIXELS, seed=5)


def double(gaussians: Gaussians) -> Gaussians:
    return Gaussians(**{name: tensor.double() for name, tensor in gaussians.tensors().items()})


def test_leaving_out_unseen_splats_changes_nothing(scene, truth):
    """Compares all splats at all pixels with a few pixels and the splats visible there."""
    gaussians, camera = scene
    leaves = Gaussians(**{k: t.requires_grad_() for k, t in double(gaussians).tensors().items()})
    whole = reference.render(leaves, camera)
    (whole.image * truth.grad_image.double()).sum().backward()
    assert 0 < truth.seen < SPLATS // 2
    assert truth.safe.all()
    # Only the order of the sums in a matrix product differs.
    torch.testing.assert_close(
        truth.colours, whole.image.detach().reshape(-1, 3)[PIXELS], rtol=1e-13, atol=1e-15
    )
    for name, tensor in leaves.tensors().items():
        exact = truth.gradients.tensors()[name]
        assert exact.abs().max() > 0
        torch.testing.assert_close(exact, tensor.grad, rtol=1e-10, atol=1e-13)
        assert torch.equal(exact == 0, tensor.grad == 0)


def test_seen_splats_are_those_that_reach_the_cut(scene):
    gaussians, camera = scene
    splats = reference.project(double(gaussians), camera, 16, False)
    offsets = pixel_centres(PIXELS, WIDTH)[:, None] - splats.means[None]
    a, b, c = splats.conics.unbind(-1)
    dx, dy = offsets.unbind(-1)
    alpha = splats.opacities * torch.exp(-0.5 * (a * dx * dx + 2 * b * dx * dy + c * dy * dy))
    depths = gaussians.means.double() @ torch.from_numpy(camera.world_to_camera[2, :3])
    order = torch.argsort(depths.float(), stable=True)
    expected = order[(alpha >= constants.ALPHA_CUT).any(0)].sort().values
    assert torch.equal(seen_at(double(gaussians), camera, PIXELS), expected)


def test_planted_error_is_measured(scene, truth):
    image = torch.zeros(HEIGHT * WIDTH, 3, dtype=torch.float64)
    image[PIXELS] = truth.colours
    perfect = accuracy(truth, image, truth.gradients)
    assert perfect.image.max == 0 and perfect.worst_gradient == 0

    image[PIXELS[2], 1] += 0.02
    image[0] += 1.0  # not compared
    gradients = truth.gradients.clone()
    gradients.rotations[int(truth.gradients.rotations.abs().amax(1).argmin()), 2] -= (
        0.3 * truth.gradients.rotations.abs().max()
    )
    gradients.sh *= 1.01
    found = accuracy(truth, image, gradients)
    assert found.image.max == pytest.approx(0.02)
    assert found.image.median == 0
    assert found.gradients["rotations"].max == pytest.approx(
        0.3
    )  # at a splat that is invisible at all pixels
    assert found.gradients["rotations"].median == 0
    assert found.gradients["sh"].max == pytest.approx(0.01)
    assert found.gradients["sh"].median == pytest.approx(0.01)
    assert found.gradients["means"].max == 0
    assert found.worst_gradient == pytest.approx(0.3)


def test_nan_gradient_is_a_large_error(truth):
    gradient = truth.gradients.means.clone()
    gradient[0, 0] = torch.nan
    assert not gradient_error(gradient, truth.gradients.means).max < 1e30


def test_pixels_near_a_cut_off_are_not_compared(scene, monkeypatch):
    gaussians, camera = scene
    pixels = torch.arange(WIDTH * HEIGHT)
    monkeypatch.setattr(oracle_module, "MARGIN", 0.02)
    found = oracle(gaussians, camera, pixels, seed=5)
    assert 0 < int((~found.safe).sum()) < len(pixels) // 2
    assert (found.grad_image.reshape(-1, 3)[~found.safe] == 0).all()
    image = found.colours.clone()
    image[~found.safe] += 0.5
    measured = accuracy(found, image, found.gradients)
    assert measured.image.max == 0
    assert measured.left_out_max == pytest.approx(0.5)
    assert measured.pixels + measured.left_out == len(pixels)


def test_kernels_agree_with_the_oracle(scene, truth):
    """The limit 1e-5 is that of the tests of the rasteriser. The compared pixels are not black."""
    found = accuracy(truth, *Iteration(*scene).image_and_gradients(truth.grad_image))
    assert truth.colours.max() > 0.2
    assert found.image.max < 5e-6
    assert 0 < found.worst_gradient < 1e-5


def test_pixels_are_distinct_and_depend_on_the_seed(monkeypatch):
    _, camera = random_scene(1, 400, 300)
    chosen = choose_pixels(camera, 1000, seed=1)
    assert len(chosen.unique()) == 1000
    assert torch.equal(chosen, choose_pixels(camera, 1000, seed=1))
    assert not torch.equal(chosen, choose_pixels(camera, 1000, seed=2))
    assert int(chosen.min()) >= 0 and int(chosen.max()) < 400 * 300
    assert len(choose_pixels(camera, 10_000_000, seed=1)) == oracle_module.MAX_PRODUCTS // 10_000_000
    assert torch.equal(choose_pixels(random_scene(1, 7, 5)[1], 10, seed=1), torch.arange(35))


def test_view_without_visible_splats(scene):
    gaussians, camera = scene
    behind = gaussians.clone()
    behind.means[:, 2] -= 100.0
    found = oracle(behind, camera, PIXELS, seed=0)
    assert found.seen == 0
    assert (found.colours == 0).all() and (found.gradients.means == 0).all()
    measured = accuracy(found, *Iteration(behind, camera).image_and_gradients(found.grad_image))
    assert measured.worst_gradient == 0 and np.isfinite(measured.image.median)
