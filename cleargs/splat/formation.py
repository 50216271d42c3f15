"""Interface between a training and image formation. `cleargs.formation` implements it."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Protocol

import torch
from torch import Tensor

from cleargs.splat.camera import Camera
from cleargs.splat.types import Render

if TYPE_CHECKING:  # it needs OpenCV, and the kernels do not
    from cleargs.splat.views import TrainingView

Renderer = Callable[[Camera], Render]
"""Function that renders the current scene with depth."""


class Formed(Protocol):
    """Image formation of one view, in one step of the training."""

    camera: Camera
    """Camera to render: that of the view, or one with a margin for pixels that move in from outside."""
    needs_depth: bool
    """True: `forward` needs the depth of the render."""
    weight: float
    """Weight of the view: the original weight, or more if image formation explains the frame."""

    affine: Tensor | None
    """Colour affine [3, 4] of the frame; None: the colours stay."""
    mask: Tensor | None
    """Pixels [H, W] that count; None: all. After `forward`, those in which something moves are left out."""

    def forward(self, render: Render) -> Tensor:
        """Return the formed image [H, W, 3] sRGB of a render."""

    def backward(self, gradient: Tensor) -> Tensor:
        """Return the gradient of the render's image, given that of the formed image [H, W, 3]."""

    def learn(self) -> None:
        """Update the learned parameters, by the gradient of the last `backward`."""


class Formation(Protocol):
    """Image formation of a capture, estimated while the scene is trained."""

    def form(
        self,
        view: TrainingView,
        factor: float,  # scale of the training image in this step
        progress: float,  # position in the schedule, 0 to 1
        observed: Tensor,  # [H, W, 3] sRGB at this scale
        mask: Tensor | None,  # [H, W] pixels that count
        render: Renderer,  # renders the current scene
    ) -> Formed | None:
        """Return the image formation for a step on a view. None: compare the view with the plain render."""

    def digest(self) -> str:
        """Return a digest of the settings and the initial values, which identifies checkpoints."""

    def state(self) -> dict[str, Tensor]:
        """Return everything that the training changes, for a checkpoint."""

    def restore(self, state: dict[str, Tensor]) -> None:
        """Continue from the result of `state`."""

    def fault(self) -> str | None:
        """Return a description of values that are not finite, or None."""


SATURATED = 253 / 255
"""Value (sRGB) from which a frame image is saturated: the light was as bright as this or brighter."""


def clip_to_saturation(image: Tensor, target: Tensor, saturated: float = SATURATED) -> tuple[Tensor, Tensor]:
    """Return a render as the sensor of a frame image records it, and a mask of the values that change.

    Both images are [H, W, 3] sRGB. If the frame image is ``saturated`` or brighter and the render is brighter
    than it, the value of the frame image replaces that of the render. So one overexposed frame does not
    darken a lamp.
    """
    too_bright = (target >= saturated) & (image > target)
    return torch.where(too_bright, target, image), too_bright
