"""Gaussians in mid-air that one view at most supports."""

from __future__ import annotations

import math

import numpy as np
import pyarrow as pa
import pytest
import torch

from cleargs.formation.floaters import floaters, without_floaters
from cleargs.formation.observed import Fit
from cleargs.splat.camera import Camera
from cleargs.splat.gaussians import Gaussians
from cleargs.splat.scene import Scene
from cleargs.splat.tables import TRAIN
from cleargs.splat.trainer import Trained
from cleargs.splat.types import Moments

DEPTH = 4.0
WALL = 24 * 16


def cameras() -> list[Camera]:
    """Six cameras that look at a wall from along a line."""
    poses = np.tile(np.eye(4), (6, 1, 1))
    poses[:, 0, 3] = 0.5 - 0.2 * np.arange(6)
    return [Camera(48, 32, 40.0, 40.0, 24.0, 16.0, pose) for pose in poses]


def scene(*others: tuple[tuple[float, float, float], float, float]) -> Scene:
    """A wall of opaque Gaussians, and others with centre, radius and opacity."""
    x, y = np.meshgrid(np.linspace(-3, 3, 24), np.linspace(-2, 2, 16))
    wall = np.stack([x.ravel(), y.ravel(), np.full(WALL, DEPTH)], axis=1)
    means = np.concatenate([wall, np.array([centre for centre, _, _ in others]).reshape(-1, 3)])
    radii = np.array([0.2] * WALL + [radius for _, radius, _ in others])
    opacity = np.array([0.9] * WALL + [opacity for _, _, opacity in others])
    count = len(means)
    tensors = {
        "means": means,
        "log_scales": np.log(radii)[:, None].repeat(3, axis=1),
        "rotations": np.tile([1.0, 0.0, 0.0, 0.0], (count, 1)),
        "logit_opacities": np.log(opacity / (1 - opacity)),
        "sh": np.zeros((count, 1, 3)),
    }
    return Scene(Gaussians(**{name: torch.from_numpy(a.astype(np.float32)) for name, a in tensors.items()}))


HAZE = ((0.0, 0.0, 2.0), 0.1, 0.2)
BALL = ((0.0, 0.6, 2.0), 0.25, 0.99)
BEHIND = ((0.0, 0.0, 6.0), 0.2, 0.9)
ASIDE = ((-1.9, 0.0, 2.6), 0.1, 0.2)
"""In the picture of the first camera alone."""


def test_only_what_most_views_see_through_is_a_floater() -> None:
    """The haze is. A ball that all views see, and a thing behind the wall, are not."""
    assert floaters(scene(HAZE, BALL, BEHIND), cameras()).nonzero().ravel().tolist() == [WALL]


def test_a_place_that_fewer_than_three_views_see_has_no_witness() -> None:
    assert not floaters(scene(ASIDE), cameras()).any()
    assert floaters(scene(ASIDE), [cameras()[0]] * 3)[WALL]


@pytest.mark.parametrize(("after", "removed"), [(30.0, 1), (30.1, 1), (29.9, 0), (math.nan, 0)])
def test_floaters_stay_if_unseen_pixels_get_worse(after: float, removed: int) -> None:
    whole = scene(HAZE)
    state = Moments.zeros(whole.gaussians).state() | {"step": torch.tensor(5)}
    state |= {f"parameter.{name}": tensor for name, tensor in whole.gaussians.tensors().items()}
    trained = Trained(whole, pa.Table.from_pylist([], TRAIN), state)

    def evaluate(which: Scene) -> list[Fit]:
        unseen = 30.0 if which.gaussians.num == WALL + 1 else after
        return [Fit(25.0, None if math.isnan(unseen) else unseen)]

    got, fits = without_floaters(trained, cameras(), "cpu", evaluate)
    assert got.scene.gaussians.num == WALL + 1 - removed
    assert fits == [Fit(25.0, after if removed else 30.0)]
    assert (
        got.state["first.means"].shape
        == got.state["parameter.means"].shape
        == got.scene.gaussians.means.shape
    )
    assert int(got.state["step"]) == 5
