"""Floaters: Gaussians in mid-air, in front of what the frames see there."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from cleargs.formation.observed import Fit, pooled_unseen
from cleargs.splat.backend import rasteriser_for
from cleargs.splat.camera import Camera
from cleargs.splat.scene import Scene
from cleargs.splat.trainer import Trained

NEAR, FAR = 0.8, 1.25
"""Depths, over that of the scene in the same pixel, between which a Gaussian is part of what a view sees."""
MIN_AGAINST, MAX_FOR = 3, 1
"""Fewest views that see through a floater, and most views of whose surface it is a part."""
OPAQUE = 0.5
"""Alpha from which a pixel has a depth."""

_OF_GAUSSIANS = ("parameter.", "first.", "second.", "strategy.")
"""Prefixes of the tensors in a training state that have a row per Gaussian."""


def floaters(scene: Scene, cameras: Iterable[Camera]) -> Tensor:  # [N] bool
    """Return True for Gaussians that one view at most supports, and that at least three views contradict.

    A view supports a Gaussian whose centre has about the depth of the scene in its pixel. It contradicts one
    that is nearer by a fifth, since it sees through it. Centres that are farther away are hidden from it.
    """
    engine = rasteriser_for(scene.gaussians.device)
    means = scene.gaussians.means.detach().cpu().numpy().astype(np.float64)
    against, support = np.zeros(len(means), np.int64), np.zeros(len(means), np.int64)
    for camera in cameras:
        render = engine.view(scene, camera, depth=True)
        assert render.depth is not None
        alpha = render.alpha.cpu().numpy()
        depth = render.depth.cpu().numpy() / np.maximum(alpha, 1e-6)
        pose = camera.world_to_camera
        x, y, z = np.einsum("ij,nj->in", pose[:3, :3], means) + pose[:3, 3:]
        ahead = np.maximum(z, 1e-6)
        column = np.floor(x / ahead * camera.fx + camera.cx)
        row = np.floor(y / ahead * camera.fy + camera.cy)
        inside = (z > 0.0) & (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
        at = np.where(inside, row, 0).astype(np.intp), np.where(inside, column, 0).astype(np.intp)
        inside &= alpha[at] > OPAQUE
        against += inside & (z < NEAR * depth[at])
        support += inside & (z >= NEAR * depth[at]) & (z <= FAR * depth[at])
    return torch.from_numpy((against >= MIN_AGAINST) & (support <= MAX_FOR))


def without_floaters(
    trained: Trained, cameras: Iterable[Camera], device: str, evaluate: Callable[[Scene], list[Fit]]
) -> tuple[Trained, list[Fit]]:
    """Remove the floaters, unless the pixels that no training saw get worse.

    Args:
        trained: A finished training.
        cameras: Cameras of its views.
        device: Device of the renders.
        evaluate: Compares a scene on ``device`` with all views.

    Returns:
        The training with fewer Gaussians, or as it is, and its fits.
    """
    scene = trained.scene.to(device)
    before = evaluate(scene)
    keep = ~floaters(scene, cameras)
    if bool(keep.all()) or not bool(keep.any()):
        return trained, before
    gaussians = trained.scene.gaussians.select(keep)
    fewer = replace(trained.scene, gaussians=gaussians)
    after = evaluate(fewer.to(device))
    unseen = pooled_unseen(before), pooled_unseen(after)
    if unseen[0] is None or unseen[1] is None or unseen[1] < unseen[0]:
        return trained, before
    state = {
        name: tensor[keep] if name.startswith(_OF_GAUSSIANS) else tensor
        for name, tensor in trained.state.items()
    }
    return replace(trained, scene=fewer, state=state), after
