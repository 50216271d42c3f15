"""Random splats that fill a view evenly."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from cleargs.splat.camera import Camera
from cleargs.splat.gaussians import Gaussians

MEDIAN_SIGMA = 1.8
"""Median standard deviation of the projected splats, px: about five tiles a splat with its tails."""


def random_scene(
    count: int, width: int, height: int, *, sigma: float = MEDIAN_SIGMA, seed: int = 0
) -> tuple[Gaussians, Camera]:
    """``count`` splats of SH degree 3 and about ``sigma`` px, evenly over the view of a camera at the origin.

    The same splats for the same arguments. Opacities lie in [0.05, 0.95], depths in [2, 10].
    """
    rng = np.random.default_rng(seed)
    focal = 0.87 * width
    z = rng.uniform(2.0, 10.0, count)
    u, v = (side * rng.uniform(-0.03, 1.03, count) for side in (width, height))
    means = np.stack([(u - width / 2) / focal * z, (v - height / 2) / focal * z, z], 1)
    deviations = sigma * np.exp(rng.normal(0, 0.5, count)) * z / focal
    scales = deviations[:, None] * np.exp(rng.normal(0, 0.5, (count, 3)))
    opacities = rng.uniform(0.05, 0.95, count)
    sh = rng.normal(0, 0.15, (count, 16, 3))
    sh[:, 0] = rng.normal(0, 1, (count, 3))
    gaussians = Gaussians(
        _float32(means),
        _float32(np.log(scales)),
        _float32(rng.normal(size=(count, 4))),
        _float32(np.log(opacities / (1 - opacities))),
        _float32(sh),
    )
    return gaussians, Camera(width, height, focal, focal, width / 2, height / 2, np.eye(4))


def random_image(width: int, height: int, seed: int = 1) -> Tensor:
    """An image [H, W, 3] of independent values in [0, 1)."""
    return _float32(np.random.default_rng(seed).uniform(size=(height, width, 3)))


def _float32(array: NDArray[np.float64]) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(array, np.float32))
