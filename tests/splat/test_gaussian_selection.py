"""Gaussians that an export leaves out: by contribution, or by a box."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from test_export import make_scene

from cleargs.render.pruning import central_box, inside
from cleargs.scene.dust import contributions
from cleargs.splat.camera import Camera
from cleargs.splat.gaussians import Gaussians
from cleargs.splat.render import render
from cleargs.splat.scene import Scene

CAMERA = Camera(48, 36, 40.0, 40.0, 24.0, 18.0, np.eye(4))


def nothing() -> None: ...


def test_contributions_sum_to_alpha() -> None:
    """Weights sum to 1 - T in each pixel, also with negative colours and antialiasing."""
    made = make_scene(60, 4)
    made.gaussians.sh[:, 0] -= 3.0  # darker than black, so the render clamps them
    for antialias in (False, True):
        scene = Scene(made.gaussians, antialias=antialias)
        total = float(contributions(scene, [CAMERA], nothing).double().sum())
        alpha = float(render(scene.gaussians, CAMERA, antialias=antialias).alpha.double().sum())
        assert alpha > 100 and total == pytest.approx(alpha, rel=1e-4)


def test_contribution_is_that_of_the_best_view() -> None:
    gaussians = Gaussians(
        means=torch.tensor([[0.0, 0, 2], [0.0, 0, 4], [0.0, 0, -2]]),
        log_scales=torch.full((3, 3), -1.5),
        rotations=torch.tensor([[1.0, 0, 0, 0]]).repeat(3, 1),
        logit_opacities=torch.full((3,), 6.0),
        sh=torch.zeros(3, 1, 3),
    )
    # The far Gaussian is visible through the transparent rim of the near one.
    back = np.diag([-1.0, 1, -1, 1])  # rotated about y, so it sees only the third
    ahead = contributions(Scene(gaussians), [CAMERA], nothing)
    assert ahead[0] > 50 and 0 < ahead[1] < ahead[0] / 10 and ahead[2] == 0
    turned = Camera(48, 36, 40.0, 40.0, 24.0, 18.0, back)
    both = contributions(Scene(gaussians), [CAMERA, turned], nothing)
    assert torch.equal(both[:2], ahead[:2]) and both[2] == pytest.approx(float(ahead[0]), rel=1e-4)


def test_boxes() -> None:
    means = torch.tensor([[0.0, 0, 0], [1.0, 0, 0], [0.0, 1.5, 0], [9.0, 9, 9]])
    assert inside(means, np.zeros(3), np.ones(3)).tolist() == [True, True, False, False]
    chance = np.random.default_rng(0)
    cloud = torch.from_numpy(chance.normal(size=(20_000, 3)) * [1, 2, 3])
    low, high = central_box(cloud, 90.0)
    assert np.allclose(high / [1, 2, 3], 1.645, atol=0.06) and np.allclose(low, -high, rtol=0.06)
    assert inside(cloud, *central_box(cloud, 100.0)).all()
