"""A render as the camera of one frame saw it, and the way back of its gradient."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from cleargs.formation.exposure import AffineOptimiser, affine_backward, apply_affine
from cleargs.formation.frame import FrameFormation, margin_for, widened
from cleargs.formation.unexplained import Doubt
from cleargs.formation.warp import (
    Warp,
    displacement_fields,
    linear_curve,
    srgb_curve,
    through_curve,
    times_slope,
)
from cleargs.splat.camera import Camera
from cleargs.splat.kernels.warp_layout import CHANNELS
from cleargs.splat.types import Render


@dataclass(eq=False)
class FormedView:
    """Fulfils `cleargs.splat.formation.Formed`: colour, then motion and defocus in linear light.

    With a ``doubt``, pixels that stay unexplained teach less.
    """

    camera: Camera
    weight: float
    frame_id: int = -1
    affine: Tensor | None = None
    affines: AffineOptimiser | None = None
    formation: FrameFormation | None = None
    factor: float = 1.0
    doubt: Doubt | None = None

    def __post_init__(self) -> None:
        self._photo = self.camera
        self._margin = 0
        if self.formation is not None:
            self._margin = margin_for(self.formation.reach_px * self.factor, self._photo)
            self.camera = widened(self._photo, self._margin)
        self.needs_depth = self.formation is not None

    def forward(self, render: Render) -> Tensor:
        photograph = self._photograph(render)
        if self.doubt is not None:
            self._counts = self.doubt.counts(photograph)
        return photograph

    def _photograph(self, render: Render) -> Tensor:
        image = render.image
        if self.affine is not None:
            self._rendered = render.image
            image = apply_affine(image, self.affine)
        if self.formation is None:
            return image
        self._warp = self.warp(render)
        linear, self._to_linear = through_curve(image, linear_curve(image.device), CHANNELS)
        photograph, self._to_srgb = through_curve(self._warp.forward(linear), srgb_curve(image.device))
        return photograph

    def warp(self, render: Render) -> Warp:
        """B of the frame, from a render at ``camera`` with depth."""
        assert self.formation is not None and render.depth is not None
        fields = displacement_fields(
            self.formation.motion, self._photo, render.depth, render.alpha, self._margin, self.factor
        )
        return Warp.of(fields, self._margin)

    def backward(self, gradient: Tensor) -> Tensor:
        if self.doubt is not None:
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
