"""What a finished scene shows at a frame: sharp, and as the frame's camera saw it."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from cleargs.formation.exposure import Exposure
from cleargs.formation.frame import FrameFormation
from cleargs.formation.view import FormedView
from cleargs.splat.backend import psnr, rasteriser_for
from cleargs.splat.kernels.rasteriser import Rasteriser
from cleargs.splat.scene import Scene
from cleargs.splat.views import ImageCache, View, unseen_pixels


def photograph(
    scene: Scene,
    view: View,
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
    render = engine.forward(
        scene.gaussians,
        formed.camera,
        background=scene.background,
        antialias=scene.antialias,
        depth=formed.needs_depth,
    )
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
    views: Sequence[View],
    exposure: Exposure | None = None,
    formations: Mapping[int, FrameFormation] | None = None,
    *,
    engine: Rasteriser | None = None,
    cache: ImageCache | None = None,
) -> list[Fit]:
    """How well the scene shows every view as photographed, in their order, at full size."""
    engine = engine or rasteriser_for(str(scene.gaussians.device))
    cache = cache or ImageCache(0, scene.gaussians.device)
    formations = formations or {}
    fits = []
    for view in views:
        target, mask = cache.get(view)
        image = photograph(scene, view, exposure, formations.get(view.frame_id), engine=engine)
        unseen = torch.from_numpy(unseen_pixels(view.frame_id, *target.shape[:2])).to(target.device)
        unseen = unseen if mask is None else unseen & mask
        fits.append(
            Fit(psnr(image, target, mask), psnr(image, target, unseen) if bool(unseen.any()) else None)
        )
    return fits
