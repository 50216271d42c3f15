"""Gaussians that no training view shows are dropped, with their moments, if the frames lose nothing."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pyarrow as pa
import pytest
import torch
from helpers import splat_toy

from cleargs.scene.dust import FAR, MAX_LOSS, drawn_in, middle_box, without_dust
from cleargs.splat.backend import mean_psnr
from cleargs.splat.gaussians import Gaussians
from cleargs.splat.scene import Scene
from cleargs.splat.training import Trained
from cleargs.splat.types import Moments


def trained(gaussians: Gaussians) -> Trained:
    """A finished training whose moments are numbered by Gaussian."""
    moments = Moments.zeros(gaussians)
    for tensors in (moments.first, moments.second):
        for tensor in tensors.values():
            tensor += torch.arange(gaussians.num).reshape(-1, *[1] * (tensor.ndim - 1))
    state = {
        "fingerprint": torch.zeros(32),
        **moments.state(),
        "strategy.errors": torch.arange(gaussians.num),
    }
    return Trained(Scene(gaussians), pa.table({}), state)


def together(first: Gaussians, second: Gaussians) -> Gaussians:
    other = second.tensors()
    return Gaussians(**{name: torch.cat([tensor, other[name]]) for name, tensor in first.tensors().items()})


def test_dust_is_dropped_with_its_moments() -> None:
    truth = splat_toy.gaussians()
    pictures = splat_toy.views(splat_toy.images(truth, 4))
    far = replace(truth.select(torch.arange(1)), means=torch.tensor([[0.0, 90.0, 0.0]]))
    done = without_dust(trained(together(far, truth)), pictures, None, {}, {}, "cpu")
    kept = done.trained.scene.gaussians
    assert kept.num <= truth.num and float(kept.means.abs().max()) < 1
    numbers = done.trained.state["first.logit_opacities"]
    assert len(numbers) == kept.num and int(numbers.min()) >= 1
    assert torch.equal(numbers, done.trained.state["strategy.errors"].to(numbers.dtype))
    assert torch.equal(kept.means, together(far, truth).means[numbers.long()])
    assert len(done.trained.state["fingerprint"]) == 32
    assert len(done.fits) == len(done.compared) == 4


def test_faint_gaussians_that_show_together_stay() -> None:
    """A haze of many Gaussians, each of a hundredth of a pixel."""
    truth = splat_toy.gaussians()
    haze = splat_toy.gaussians(8000, seed=3)
    haze = replace(haze, log_scales=haze.log_scales - 1.0, logit_opacities=torch.full((haze.num,), -5.0))
    both = together(haze, truth)
    pictures = splat_toy.views(splat_toy.images(both, 4))
    whole = without_dust(trained(both), pictures, None, {}, {}, "cpu")
    assert torch.equal(whole.trained.scene.gaussians.means, both.means)
    fits = without_dust(trained(truth), pictures, None, {}, {}, "cpu").fits
    lost = mean_psnr(fit.psnr for fit in whole.fits), mean_psnr(fit.psnr for fit in fits)
    assert lost[0] is not None and lost[1] is not None and lost[0] - lost[1] > MAX_LOSS


def test_unseen_gaussians_inside_the_scene_stay() -> None:
    """They are too small to count alone, and the box does not change without them."""
    truth = splat_toy.gaussians()
    few = truth.select(torch.arange(5))
    small = replace(few, logit_opacities=torch.full((5,), -9.0))
    pictures = splat_toy.views(splat_toy.images(truth, 4))
    done = without_dust(trained(together(small, truth)), pictures, None, {}, {}, "cpu")
    assert done.dropped == 0 and done.trained.scene.gaussians.num == truth.num + 5


def test_what_is_far_outside_moves_on_the_line_to_the_cameras_and_shrinks() -> None:
    truth = splat_toy.gaussians()
    far = replace(truth.select(torch.arange(2)), means=torch.tensor([[0.0, 90.0, 3.0], [-20.0, 1.0, -30.0]]))
    both, eye = together(far, truth), torch.tensor([0.3, 0.1, -0.2])
    nearer = drawn_in(both, eye)
    middle, reach = middle_box(both.means)
    assert torch.allclose(((nearer.means[:2] - middle).abs() / reach).amax(dim=1), torch.tensor(FAR))
    before, after = both.means[:2] - eye, nearer.means[:2] - eye
    share = torch.linalg.vector_norm(after, dim=1) / torch.linalg.vector_norm(before, dim=1)
    assert torch.allclose(after, share[:, None] * before, atol=1e-5)
    change = nearer.log_scales[:2] - both.log_scales[:2]
    assert torch.allclose(change, share.log()[:, None].expand(-1, 3), atol=1e-5)
    assert torch.equal(nearer.means[2:], truth.means) and torch.equal(nearer.log_scales[2:], truth.log_scales)


@pytest.mark.parametrize("cameras", [1, 4])
def test_it_is_drawn_in_if_the_frames_lose_nothing(cameras: int) -> None:
    """A large Gaussian far behind the scene. One camera sees no change, four see parallax."""
    truth = splat_toy.gaussians()
    far = replace(
        truth.select(torch.arange(1)),
        means=torch.tensor([[1.0, 0.0, 40.0]]),
        log_scales=torch.full((1, 3), math.log(6.0)),
    )
    both, rng = together(truth, far), np.random.default_rng(0)
    noisy = [
        np.clip(image + rng.normal(0, 8, image.shape), 0, 255).astype(np.uint8)
        for image in splat_toy.images(both, cameras)
    ]
    done = without_dust(trained(both), splat_toy.views(noisy), None, {}, {}, "cpu")
    last = float(done.trained.scene.gaussians.means[-1, 2])
    assert done.dropped == 0 and done.drawn_in == (cameras == 1)
    assert last < 3.0 if cameras == 1 else last == 40.0


def test_without_a_frame_nothing_changes() -> None:
    """No frame says what may go: the mean of no cameras is not a number."""
    truth = splat_toy.gaussians()
    far = replace(truth.select(torch.arange(1)), means=torch.tensor([[0.0, 90.0, 0.0]]))
    repaired = [replace(view, kind="pseudo") for view in splat_toy.views(splat_toy.images(truth, 2))]
    done = without_dust(trained(together(far, truth)), repaired, None, {}, {}, "cpu")
    assert torch.equal(done.trained.scene.gaussians.means, together(far, truth).means)
