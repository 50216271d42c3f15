"""The formed image of a frame (its render after image formation) and its gradient."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from cleargs.formation.exposure import AffineOptimiser, Exposure
from cleargs.formation.frame import FrameFormation, margin_for
from cleargs.formation.motion import readout_of, widened
from cleargs.formation.warp import Warp, displacement_fields, linear_curve, srgb_curve
from cleargs.splat.backend import backend_for, rasteriser_for
from cleargs.splat.camera import Camera
from cleargs.splat.kernels.rasteriser import Rasteriser
from cleargs.splat.kernels.warp_layout import CHANNELS
from cleargs.splat.scene import Scene
from cleargs.splat.types import Render
from cleargs.splat.views import TrainingView


@dataclass(eq=False)
class FormedView:
    """Implementation of `cleargs.splat.formation.Formed`: colour, then motion and defocus in linear light.

    A rolling shutter is a part of the camera: each Gaussian is seen from the pose at which its row was read.
    With ``global_shutter``, the render is that of a global shutter, and `warp` has the skew too, to undo it.

    ``check`` receives each formed image with its render and margin, and returns the pixels that count: see
    `cleargs.formation.movement`.
    """

    camera: Camera
    weight: float
    frame_id: int = -1
    affine: Tensor | None = None
    affines: AffineOptimiser | None = None
    formation: FrameFormation | None = None
    factor: float = 1.0
    mask: Tensor | None = None
    check: Callable[[Tensor, Render, int], Tensor | None] | None = None
    global_shutter: bool = False

    def __post_init__(self) -> None:
        """Widen the camera by the margin that the formation needs, and let its shutter roll."""
        self._frame_camera = self.camera
        self._margin = 0
        self._motion = None if self.formation is None else self.formation.motion
        if self._motion is not None and self._motion.skew.any() and not self.global_shutter:
            readout = readout_of(self._motion, self._frame_camera, self.factor)
            self.camera = replace(self.camera, readout=readout)
            self._motion = self._motion.exposed_only()
        if self.formation is not None and self._motion is not None:
            self._margin = margin_for(self.formation.displacement_px * self.factor, self._frame_camera)
            self.camera = widened(self.camera, self._margin)
        self.needs_depth = self._motion is not None or self.check is not None

    def forward(self, render: Render) -> Tensor:
        """Return the formed image [H, W, 3] sRGB of a render at ``camera``."""
        image, device = render.image, render.image.device
        backend = backend_for(device)
        if self.affine is not None:
            self._rendered = render.image
            image = backend.apply_affine(image, self.affine)
        if self._motion is not None:
            self._warp = self.warp(render)
            linear, self._to_linear = backend.through_curve(image, linear_curve(device), CHANNELS)
            image, self._to_srgb = backend.through_curve(self._warp.forward(linear), srgb_curve(device), 3)
        if self.check is not None:
            self.mask = self.check(image, render, self._margin)
        return image

    def warp(self, render: Render) -> Warp:
        """Return the operator B of the frame (`Warp`), from a render at ``camera`` with depth."""
        assert self._motion is not None and render.depth is not None
        fields = displacement_fields(
            self._motion, self._frame_camera, render.depth, render.alpha, self._margin, self.factor
        )
        return Warp.of(fields, self._margin)

    def backward(self, gradient: Tensor) -> Tensor:
        """Return the gradient by the render's image, from that by the formed image."""
        backend = backend_for(gradient.device)
        if self._motion is not None:
            light = backend.times_slope(gradient, self._to_srgb, CHANNELS)
            gradient = backend.times_slope(self._warp.transpose(light), self._to_linear, 3)
        if self.affine is not None:
            gradient, self._affine_gradient = backend.affine_backward(self._rendered, self.affine, gradient)
        return gradient

    def learn(self) -> None:
        """Step the colour affine along the gradient of the last `backward`."""
        if self.affines is not None:
            self.affines.step(self.frame_id, self._affine_gradient.cpu().numpy())


def render_formed(
    scene: Scene,
    view: TrainingView,
    exposure: Exposure | None = None,
    formation: FrameFormation | None = None,
    *,
    engine: Rasteriser | None = None,
) -> Tensor:
    """Render ``scene`` as the camera of a view records it: [H, W, 3] sRGB in [0, 1], in new memory.

    Without ``exposure`` the colours do not change. Without ``formation`` the render is sharp. ``engine``
    is a rasteriser of the scene's device.
    """
    engine = engine or rasteriser_for(str(scene.gaussians.device))
    affine = None if exposure is None else torch.from_numpy(exposure.of(view.frame_id).astype(np.float32))
    moved = formation if formation is not None and formation.model != "none" else None
    formed = FormedView(view.camera, view.weight, affine=affine, formation=moved)
    render = engine.view(scene, formed.camera, depth=formed.needs_depth)
    return formed.forward(render).clamp(0.0, 1.0)
