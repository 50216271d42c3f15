"""A random scene and its camera, for the self-test of the GPU, benchmarks and tests."""

from __future__ import annotations

import numpy as np
import torch

from cleargs.splat.camera import Camera
from cleargs.splat.gaussians import Gaussians


def random_scene(
    count: int, width: int, height: int, *, sigma: float = 1.8, seed: int = 0
) -> tuple[Gaussians, Camera]:
    """Return random Gaussians of SH degree 3 in the view of a camera at the origin, and the camera.

    The density in the image of ``width`` x ``height`` px is uniform. Opacities are in [0.05, 0.95], depths in
    [2, 10]. ``sigma`` is the median standard deviation of a projected splat, px. Equal arguments give equal
    Gaussians.
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
    rotations = rng.normal(size=(count, 4))
    parameters = (means, np.log(scales), rotations, np.log(opacities / (1 - opacities)), sh)
    tensors = (torch.from_numpy(array.astype(np.float32)) for array in parameters)
    return Gaussians(*tensors), Camera(width, height, focal, focal, width / 2, height / 2, np.eye(4))
