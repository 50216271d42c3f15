"""The PSNR of a scene on its views, after image formation."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import torch

from cleargs.formation.exposure import Exposure
from cleargs.formation.formed import render_formed
from cleargs.formation.frame import FrameFormation
from cleargs.formation.movement import counted
from cleargs.splat.backend import psnr, rasteriser_for
from cleargs.splat.kernels.rasteriser import Rasteriser
from cleargs.splat.scene import Scene
from cleargs.splat.views import ImageCache, TrainingView, unseen_pixels
from cleargs.types import MaskBool

MAX_EVALUATED = 32
"""Maximum number of frames, evenly spread, on which a stage compares its scene with the frame images."""


class ViewPsnr(NamedTuple):
    """PSNR of a scene on one view, dB, over the pixels that count."""

    psnr: float
    unseen: float | None
    """PSNR over the `unseen_pixels` that count, dB; None if there are none."""


def pooled_unseen(fits: Iterable[ViewPsnr]) -> float | None:
    """Return the PSNR, dB, over the pixels of all views that no training saw; None if there are none.

    Errors are averaged, not PSNRs: views with little texture in these pixels would dominate a mean of PSNRs.
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
    moving: Mapping[int, MaskBool] | None = None,
    engine: Rasteriser | None = None,
) -> list[ViewPsnr]:
    """Compare the formed image of the scene with every view, in their order, at full size.

    Pixels of the cells ``moving``, by frame_id, do not count (see `cleargs.formation.movement`).
    """
    engine = engine or rasteriser_for(str(scene.gaussians.device))
    images = ImageCache(0, scene.gaussians.device)
    formations = formations or {}
    fits = []
    for view in views:
        observed, mask = images.get(view)
        mask = counted(mask, (moving or {}).get(view.frame_id), observed)
        image = render_formed(scene, view, exposure, formations.get(view.frame_id), engine=engine)
        unseen = torch.from_numpy(unseen_pixels(view.frame_id, *observed.shape[:2])).to(observed.device)
        unseen = unseen if mask is None else unseen & mask
        psnr_unseen = psnr(image, observed, unseen) if bool(unseen.any()) else None
        fits.append(ViewPsnr(psnr(image, observed, mask), psnr_unseen))
    return fits
