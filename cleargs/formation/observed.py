"""A render as the camera of a frame saw it, the way back of its gradient, and how well it fits the frame."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import adaptive_avg_pool2d, interpolate

from cleargs.formation.exposure import AffineOptimiser, Exposure, affine_backward, apply_affine
from cleargs.formation.frame import FrameFormation, margin_for
from cleargs.formation.motion import widened
from cleargs.formation.warp import (
    Warp,
    displacement_fields,
    linear_curve,
    srgb_curve,
    through_curve,
    times_slope,
)
from cleargs.splat.backend import psnr, rasteriser_for
from cleargs.splat.camera import Camera
from cleargs.splat.kernels.rasteriser import Rasteriser
from cleargs.splat.kernels.warp_layout import CHANNELS
from cleargs.splat.scene import Scene
from cleargs.splat.types import Render
from cleargs.splat.views import ImageCache, TrainingView, unseen_pixels

ERROR_CELLS = 24
"""Cells along the longer side of a frame. Over a cell, detail that is missing or lies a little beside its
place cancels out; what does not belong to the scene does not."""

MEDIAN_FACTOR = 5.0
"""Multiple of the frame's median difference that is an ordinary one still: where all of a frame differs, as
with an exposure that is not known yet, nothing moves."""

EPSILON = 1e-6
"""Difference, and share of the pixels, that stands for none."""


def pixel_weights(
    render: Tensor,  # [H, W, 3] sRGB
    target: Tensor,  # [H, W, 3] sRGB
    mask: Tensor | None,  # [H, W], True counts
    tolerance: float,
) -> Tensor:
    """How much each pixel counts, [H, W] in (0, 1], of a frame taken as ``target``, which ``render`` must
    explain.

        w = min(1, rho / r)^2,  rho = max(tolerance, 5 median r)

    r is the difference of the mean colours of a cell, interpolated between the cells. Where it is below
    rho, w is 1 to the bit. Differences, in sRGB of [0, 1], are pooled as in Sabour et al., "RobustNeRF"
    (2023).
    """
    height, width = render.shape[:2]
    per_pixel = ERROR_CELLS / max(height, width)
    cells = max(1, round(per_pixel * height)), max(1, round(per_pixel * width))
    counted = torch.ones_like(render[..., 0]) if mask is None else mask.float()
    difference = (render - target).permute(2, 0, 1) * counted
    shares = adaptive_avg_pool2d(counted[None], cells).clamp_min(EPSILON)
    unexplained = (adaptive_avg_pool2d(difference, cells) / shares).abs().mean(dim=0)
    ordinary = (MEDIAN_FACTOR * unexplained.median()).clamp_min(tolerance)
    here = interpolate(unexplained[None, None], (height, width), mode="bilinear")[0, 0]
    return (ordinary / here.clamp_min(EPSILON)).clamp_max(1.0).square()


@dataclass(eq=False)
class FormedView:
    """Fulfils `cleargs.splat.formation.Formed`: colour, then motion and defocus in linear light.

    ``robust_mask`` says how much each pixel [H, W] of a photograph counts (see `pixel_weights`); None: all
    alike.
    """

    camera: Camera
    weight: float
    frame_id: int = -1
    affine: Tensor | None = None
    affines: AffineOptimiser | None = None
    formation: FrameFormation | None = None
    factor: float = 1.0
    robust_mask: Callable[[Tensor], Tensor] | None = None

    def __post_init__(self) -> None:
        self._frame_camera = self.camera
        self._margin = 0
        if self.formation is not None:
            self._margin = margin_for(self.formation.reach_px * self.factor, self._frame_camera)
            self.camera = widened(self._frame_camera, self._margin)
        self.needs_depth = self.formation is not None

    def forward(self, render: Render) -> Tensor:
        image, device = render.image, render.image.device
        if self.affine is not None:
            self._rendered = render.image
            image = apply_affine(image, self.affine)
        if self.formation is not None:
            self._warp = self.warp(render)
            linear, self._to_linear = through_curve(image, linear_curve(device), CHANNELS)
            image, self._to_srgb = through_curve(self._warp.forward(linear), srgb_curve(device))
        if self.robust_mask is not None:
            self._counts = self.robust_mask(image)
        return image

    def warp(self, render: Render) -> Warp:
        """B of the frame, from a render at ``camera`` with depth."""
        assert self.formation is not None and render.depth is not None
        fields = displacement_fields(
            self.formation.motion, self._frame_camera, render.depth, render.alpha, self._margin, self.factor
        )
        return Warp.of(fields, self._margin)

    def backward(self, gradient: Tensor) -> Tensor:
        if self.robust_mask is not None:
            gradient = gradient * self._counts[..., None]
        if self.formation is not None:
            light = times_slope(gradient, self._to_srgb, CHANNELS)
            gradient = times_slope(self._warp.transpose(light), self._to_linear)
        if self.affine is not None:
            gradient, self._affine_gradient = affine_backward(self._rendered, self.affine, gradient)
        return gradient

    def learn(self) -> None:
        if self.affines is not None:
            self.affines.step(self.frame_id, self._affine_gradient.cpu().numpy())


def render_observed(
    scene: Scene,
    view: TrainingView,
    exposure: Exposure | None = None,
    formation: FrameFormation | None = None,
    *,
    engine: Rasteriser | None = None,
) -> Tensor:
    """What ``scene`` shows at a view: [H, W, 3] sRGB in [0, 1], own memory.

    Through the frame's colour affine where ``exposure`` is given, and through its motion and defocus where
    ``formation`` is.
    """
    engine = engine or rasteriser_for(str(scene.gaussians.device))
    affine = None if exposure is None else torch.from_numpy(exposure.of(view.frame_id).astype(np.float32))
    moved = formation if formation is not None and formation.model != "none" else None
    formed = FormedView(view.camera, view.weight, affine=affine, formation=moved)
    render = engine.view(scene, formed.camera, depth=formed.needs_depth)
    return formed.forward(render).clamp(0.0, 1.0)


class Fit(NamedTuple):
    """How well a scene shows one view, PSNR in dB over the pixels that count."""

    psnr: float
    unseen: float | None
    """Over those of the `unseen_pixels`; None where there are none."""


def pooled_unseen(fits: Iterable[Fit]) -> float | None:
    """PSNR in dB of the pixels that no training saw, of all views together; None where there are none.

    Their errors are averaged, not their PSNRs: a view has so few that some blocks show next to nothing.
    """
    errors = [10.0 ** (-0.1 * fit.unseen) for fit in fits if fit.unseen is not None]
    error = math.fsum(errors) / len(errors) if errors else 0.0
    return -10.0 * math.log10(error) if error > 0.0 else None


def evaluate_views(
    scene: Scene,
    views: Sequence[TrainingView],
    exposure: Exposure | None = None,
    formations: Mapping[int, FrameFormation] | None = None,
    *,
    engine: Rasteriser | None = None,
) -> list[Fit]:
    """How well the scene shows every view as photographed, in their order, at full size."""
    engine = engine or rasteriser_for(str(scene.gaussians.device))
    images = ImageCache(0, scene.gaussians.device)
    formations = formations or {}
    fits = []
    for view in views:
        target, mask = images.get(view)
        image = render_observed(scene, view, exposure, formations.get(view.frame_id), engine=engine)
        unseen = torch.from_numpy(unseen_pixels(view.frame_id, *target.shape[:2])).to(target.device)
        unseen = unseen if mask is None else unseen & mask
        fits.append(
            Fit(psnr(image, target, mask), psnr(image, target, unseen) if bool(unseen.any()) else None)
        )
    return fits
