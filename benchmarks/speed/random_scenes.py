"""Scenes and images for benchmarks, in addition to `cleargs.splat.random_scene.random_scene`."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from cleargs.splat.camera import Camera
from cleargs.splat.constants import SH_C0
from cleargs.splat.gaussians import Gaussians


def surface_scene(
    count: int, width: int, height: int, *, near: float = 3.0, far: float = 6.0, seed: int = 0
) -> tuple[Gaussians, Camera]:
    """Return a scene of opaque splats (SH degree 3) on a textured slanted wall with a box in front of it.

    Unlike a random scene it has surfaces and a depth edge, as a real scene. The wall continues behind the box
    and outside the view.

    Args:
        count: Approximate number of splats.
        width: Image width, px.
        height: Image height, px.
        near: Depth of the box.
        far: Mean depth of the wall.
        seed: Seed of the positions and rotations.
    """
    rng = np.random.default_rng(seed)
    focal = 0.87 * width
    beyond, box = 0.15, 0.4  # as shares of the view's sides
    spacing = np.sqrt(width * height * ((1 + 2 * beyond) ** 2 + box**2) / count)
    parts = []
    for low, high, front in ((-beyond, 1 + beyond, False), (0.5 - box / 2, 0.5 + box / 2, True)):
        sides = [np.arange(low * side, high * side, spacing) for side in (width, height)]
        grid = np.stack(np.meshgrid(*sides), -1).reshape(-1, 2)
        u, v = (grid + rng.uniform(0, spacing, grid.shape)).T
        z = np.full(len(u), near) if front else far * (1 + 0.3 * (u / width - 0.5))
        cells = np.stack([u // 12, v // 12], 1).astype(int) + 1000 * front
        shade = ((cells[:, :1] * 37 + cells[:, 1:] * 101) % np.array([7, 11, 13])) / np.array(
            [8, 12, 14]
        ) + 0.1
        parts.append(np.column_stack([(u - width / 2) / focal * z, (v - height / 2) / focal * z, z, shade]))
    means, colours = np.split(np.concatenate(parts), [3], axis=1)
    scales = np.repeat(0.6 * spacing * means[:, 2:] / focal, 3, axis=1)
    sh = np.zeros((len(means), 16, 3))
    sh[:, 0] = (colours - 0.5) / SH_C0
    gaussians = Gaussians(
        _float32(means),
        _float32(np.log(scales)),
        _float32(rng.normal(size=(len(means), 4))),
        _float32(np.full(len(means), np.log(0.95 / 0.05))),
        _float32(sh),
    )
    return gaussians, Camera(width, height, focal, focal, width / 2, height / 2, np.eye(4))


def random_image(width: int, height: int, seed: int = 1) -> Tensor:
    """Return an image [H, W, 3] of independent uniform values in [0, 1)."""
    return _float32(np.random.default_rng(seed).uniform(size=(height, width, 3)))


def _float32(array: NDArray[np.float64]) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(array, np.float32))
