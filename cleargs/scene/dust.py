"""Gaussians far outside, which make the box of a scene too large. Viewers frame a scene by its box.

Those that no training view shows are dust, and are removed. Those that a view shows are drawn in.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from cleargs.formation.exposure import Exposure
from cleargs.formation.frame import FrameFormation
from cleargs.scene.measure import MAX_EVALUATED, ViewPsnr, evaluate_views
from cleargs.sequences import spread
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
FAR = 5.0
"""Gaussians outside the box of the middle share, enlarged by this factor, are drawn in to its faces."""
MAX_LOSS = 0.02
"""Loss of PSNR on the training views, dB, above which the dust stays, or nothing is drawn in."""


class Dusted(NamedTuple):
    """A training without dust, and how well its scene fits the views that were compared."""

    trained: Trained
    dropped: int
    """Number of Gaussians that were dust."""
    drawn_in: int
    """Number of Gaussians that were drawn in."""
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
    """Remove the `DUST` of a training, with its moments of Adam, and draw in what is `FAR` outside.

    Each of both happens only if there are frames, and they lose at most `MAX_LOSS`. ``trained`` must not be
    used again: its state is changed.
    """
    real = [view for view in views if view.kind == "real"]
    if not real:
        return Dusted(trained, 0, 0, [], [])
    few, scene = spread(real, MAX_EVALUATED), trained.scene.to(device)

    def fits_of(changed: Scene) -> list[ViewPsnr]:
        return evaluate_views(changed, few, exposure, formations, moving=moving)

    fits = fits_of(scene)
    seen = ~outside(scene.gaussians.means, OUTSIDE)
    if not seen.all():
        largest = contributions(scene, (view.camera.scaled(REDUCTION) for view in real), lambda: None)
        seen |= largest >= DUST * REDUCTION**2
    if not seen.all():
        smaller = replace(scene, gaussians=scene.gaussians.select(seen))
        if _as_good(found := fits_of(smaller), fits):
            scene, fits = smaller, found
        else:
            seen[:] = True
    far = outside(scene.gaussians.means, FAR)
    if far.any():
        centre = np.mean([view.camera.centre for view in real], axis=0)
        nearer = replace(
            scene, gaussians=drawn_in(scene.gaussians, torch.tensor(centre, dtype=torch.float32))
        )
        if _as_good(found := fits_of(nearer), fits):
            scene, fits = nearer, found
        else:
            far[:] = False
    state, kept = trained.state, seen.cpu()
    if not kept.all():
        for name in state:  # one after the other, so that there are never two whole copies
            if name.startswith(("first.", "second.", "strategy.")):
                state[name] = state[name][kept]
    done = replace(trained, scene=scene.to("cpu"))
    return Dusted(done, int((~seen).sum()), int(far.sum()), few, fits)


def _as_good(fits: Sequence[ViewPsnr], before: Sequence[ViewPsnr]) -> bool:
    """Return True if views lose at most `MAX_LOSS`."""
    psnr = [mean_psnr(fit.psnr for fit in each) or 0.0 for each in (before, fits)]
    return psnr[1] >= psnr[0] - MAX_LOSS


def middle_box(means: Tensor) -> tuple[Tensor, Tensor]:  # [N, 3] -> [3] each
    """Return the centre and half the sides of the box of the `MIDDLE` of the means along each axis."""
    order = means.sort(dim=0).values
    cut = round(0.5 * (1.0 - MIDDLE) * (len(means) - 1))
    low, high = order[cut], order[-1 - cut]
    return 0.5 * (low + high), 0.5 * (high - low)


def outside(means: Tensor, factor: float) -> Tensor:  # [N, 3] -> [N]
    """Return True for means outside the `middle_box`, enlarged by a factor."""
    middle, reach = middle_box(means)
    return ((means - middle).abs() > factor * reach).any(dim=1)


def drawn_in(gaussians: Gaussians, centre: Tensor) -> Gaussians:
    """Return the Gaussians with those that are `FAR` outside moved to the faces of that box.

    They move on the lines to ``centre`` [3], the mean of the cameras, and shrink in proportion, so they look
    almost the same from the cameras. A centre outside the box is moved into it.
    """
    middle, reach = middle_box(gaussians.means)
    centre = torch.maximum(torch.minimum(centre.to(middle.device), middle + reach), middle - reach)
    start, way = centre - middle, gaussians.means - centre
    # The share of each way at which it meets a face: the smallest over the three axes.
    share = (FAR * reach - torch.sign(way) * start) / way.abs().clamp(min=1e-30)
    share = share.amin(dim=1, keepdim=True).clamp(1e-3, 1.0)
    far = share < 1.0
    means = torch.where(far, centre + share * way, gaussians.means)
    return replace(gaussians, means=means, log_scales=gaussians.log_scales + torch.log(share))


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
