"""What a finished scene shows at a frame: sharp, and as the frame's camera saw it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from torch import Tensor

from cleargs.formation.exposure import Exposure
from cleargs.formation.frame import FrameFormation
from cleargs.formation.view import FormedView
from cleargs.splat.engine import Engine
from cleargs.splat.losses import psnr
from cleargs.splat.scene import Scene
from cleargs.splat.views import ImageCache, View


def photograph(
    scene: Scene,
    view: View,
    exposure: Exposure | None = None,
    formation: FrameFormation | None = None,
    *,
    engine: Engine | None = None,
) -> Tensor:
    """What ``scene`` shows at a view: [H, W, 3] sRGB in [0, 1], own memory.

    Through the frame's colour affine where ``exposure`` is given, and through its motion and defocus where
    ``formation`` is.
    """
    engine = engine or Engine(str(scene.gaussians.device))
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


def evaluate_views(
    scene: Scene,
    views: Sequence[View],
    exposure: Exposure | None = None,
    formations: Mapping[int, FrameFormation] | None = None,
    *,
    engine: Engine | None = None,
    cache: ImageCache | None = None,
) -> list[float]:
    """PSNR in dB of every view as photographed, in their order, over unmasked pixels, at full size."""
    engine = engine or Engine(str(scene.gaussians.device))
    cache = cache or ImageCache(0, scene.gaussians.device)
    formations = formations or {}
    values = []
    for view in views:
        target, mask = cache.get(view)
        image = photograph(scene, view, exposure, formations.get(view.frame_id), engine=engine)
        values.append(psnr(image, target, mask))
    return values
