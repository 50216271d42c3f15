"""Which Gaussians to leave out of a file: those that hardly show, and those outside a box."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from cleargs.splat.backend import rasteriser_for
from cleargs.splat.camera import Camera
from cleargs.splat.constants import SH_C0
from cleargs.splat.gaussians import Gaussians
from cleargs.splat.scene import Scene


def contributions(scene: Scene, cameras: Iterable[Camera], seen: Callable[[], None]) -> Tensor:  # [N]
    """How much of a picture each Gaussian makes up: its blending weights (opacity times the transmittance in
    front of it), summed over the pixels of the camera where that sum is largest. Unit: pixels.

    A pixel is the sum of weight times colour, so the gradient of a picture's sum by a Gaussian's colour is
    the sum of its weights. The colours are set to grey, since the clamp of a negative one would hide it.
    ``seen`` is called after each camera.
    """
    gaussians = scene.gaussians.detach()
    grey = Gaussians(**{**gaussians.tensors(), "sh": torch.zeros_like(gaussians.sh[:, :1])})
    engine = rasteriser_for(gaussians.device)
    most = torch.zeros(gaussians.num, device=gaussians.device)
    for camera in cameras:
        image = engine.forward(grey, camera, antialias=scene.antialias).image
        of_red = torch.zeros_like(image)
        of_red[..., 0] = 1.0 / SH_C0
        torch.maximum(most, engine.backward(of_red).sh[:, 0, 0], out=most)
        seen()
    return most


def inside(means: Tensor, low: NDArray[np.float64], high: NDArray[np.float64]) -> Tensor:  # [N] bool
    """Which ``means`` [N, 3] lie in the box from ``low`` [3] to ``high`` [3], its faces included."""
    where = means.double()
    return ((where >= torch.from_numpy(low)) & (where <= torch.from_numpy(high))).all(dim=1)


def central_box(means: Tensor, percent: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The box that holds the middle ``percent`` of the ``means`` [N, 3] along each axis by itself."""
    margin = (100.0 - percent) / 2
    low, high = np.percentile(means.double().numpy(), [margin, 100.0 - margin], axis=0)
    return low, high
