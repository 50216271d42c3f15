"""Dust: Gaussians far outside that no training view shows. They make the box of a scene too large."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from cleargs.capture.folders import spread
from cleargs.formation.exposure import Exposure
from cleargs.formation.frame import FrameFormation
from cleargs.scene.measure import MAX_EVALUATED, ViewPsnr, evaluate_views
from cleargs.splat.backend import mean_psnr, rasteriser_for
from cleargs.splat.camera import Camera
from cleargs.splat.constants import SH_C0
from cleargs.splat.gaussians import Gaussians
from cleargs.splat.scene import Scene
from cleargs.splat.training import Trained
from cleargs.splat.views import TrainingView
from cleargs.types import MaskBool

DUST = 0.1
"""Largest contribution of a Gaussian to a training view, pixels, below which it is dust."""
REDUCTION = 0.5
"""Factor on width and height of the pictures that measure contributions: they cost a fourth of full ones."""
MIDDLE, OUTSIDE = 0.98, 1.5
"""Dust is outside the box of this middle share of the means along each axis, enlarged by this factor. Inside,
small contributions add up: without them LPIPS rose by 7 % (docs/experiments/training.md)."""
MAX_LOSS = 0.02
"""Loss of PSNR on the training views, dB, above which the dust stays."""


class Dusted(NamedTuple):
    """A training without dust, and how well its scene fits the views that were compared."""

    trained: Trained
    dropped: int
    """Number of Gaussians that were dust."""
    compared: list[TrainingView]
    fits: list[ViewPsnr]


def without_dust(
    trained: Trained,
    views: Sequence[TrainingView],  # that the training used
    exposure: Exposure | None,
    formations: Mapping[int, FrameFormation],
    moving: Mapping[int, MaskBool],
    device: str,
) -> Dusted:
    """Remove the `DUST` of a training, and its moments of Adam, if the frames lose at most `MAX_LOSS`."""
    real = [view for view in views if view.kind == "real"]
    few, scene = spread(real, MAX_EVALUATED), trained.scene.to(device)
    seen = ~outside(scene.gaussians.means)
    if not seen.all():
        largest = contributions(scene, (view.camera.scaled(REDUCTION) for view in real), lambda: None)
        seen |= largest >= DUST * REDUCTION**2
    if seen.all():
        return Dusted(trained, 0, few, evaluate_views(scene, few, exposure, formations, moving=moving))
    smaller = replace(scene, gaussians=scene.gaussians.select(seen))
    before, after = (
        evaluate_views(one, few, exposure, formations, moving=moving) for one in (scene, smaller)
    )
    psnr = [mean_psnr(fit.psnr for fit in fits) or 0.0 for fits in (before, after)]
    if psnr[1] < psnr[0] - MAX_LOSS:
        return Dusted(trained, 0, few, before)
    kept = seen.cpu()
    state = {
        name: tensor[kept] if name.startswith(("first.", "second.", "strategy.")) else tensor
        for name, tensor in trained.state.items()
    }
    smallest = replace(trained, scene=smaller.to("cpu"), state=state)
    return Dusted(smallest, int((~seen).sum()), few, after)


def outside(means: Tensor) -> Tensor:  # [N, 3] -> [N]
    """Return True for means outside the enlarged box of the middle of the scene."""
    order = means.sort(dim=0).values
    cut = round(0.5 * (1.0 - MIDDLE) * (len(means) - 1))
    low, high = order[cut], order[-1 - cut]
    reach = OUTSIDE * 0.5 * (high - low)
    return ((means - 0.5 * (low + high)).abs() > reach).any(dim=1)


def contributions(scene: Scene, cameras: Iterable[Camera], advance: Callable[[], None]) -> Tensor:  # [N]
    """Return the largest contribution of each Gaussian to one picture, in pixels.

    The contribution is the sum over pixels of the blending weight (opacity times the transmittance in front).
    A pixel's colour is the sum of weight times colour, so this is the gradient of the sum of the picture with
    respect to the colour of the Gaussian. All colours are set to grey, because a colour that is clamped at 0
    has no gradient. ``advance`` is called after each camera.
    """
    gaussians = scene.gaussians.detach()
    grey = Gaussians(**{**gaussians.tensors(), "sh": torch.zeros_like(gaussians.sh[:, :1])})
    engine = rasteriser_for(gaussians.device)
    largest = torch.zeros(gaussians.num, device=gaussians.device)
    for camera in cameras:
        image = engine.forward(grey, camera, antialias=scene.antialias).image
        red_gradient = torch.zeros_like(image)
        red_gradient[..., 0] = 1.0 / SH_C0
        torch.maximum(largest, engine.backward(red_gradient).sh[:, 0, 0], out=largest)
        advance()
    return largest
