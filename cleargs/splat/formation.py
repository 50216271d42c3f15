"""What a training knows of image formation: `cleargs.formation` fulfils it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from torch import Tensor

from cleargs.splat.camera import Camera
from cleargs.splat.types import Render
from cleargs.splat.views import TrainingView

Renderer = Callable[[Camera], Render]
"""The scene as trained so far at a camera, with depth."""


class Formed(Protocol):
    """What the camera of one view makes of a sharp render."""

    camera: Camera
    """The camera to render: the view's, or a larger one where it shows what moved in from outside."""
    needs_depth: bool
    weight: float
    """The weight of the view: its own, or what it has earned by being explained."""

    def forward(self, render: Render) -> Tensor:
        """The photograph [H, W, 3] sRGB."""

    def backward(self, gradient: Tensor) -> Tensor:
        """The gradient by the render's image, from that by the photograph."""

    def learn(self) -> None:
        """Step the numbers that follow the gradient of the last `backward`."""


class Formation(Protocol):
    """What the cameras of a capture do to sharp images, found while the scene is trained."""

    def form(
        self,
        view: TrainingView,
        factor: float,
        progress: float,
        target: Tensor,  # [H, W, 3] sRGB
        mask: Tensor | None,  # [H, W]
        render: Renderer,
    ) -> Formed | None:
        """For a step on ``view`` reduced by ``factor``, ``progress`` (0 to 1) through the training.

        None where the view shows the render as it is.
        """

    def digest(self) -> str:
        """A digest of all that it starts from."""

    def state(self) -> dict[str, Tensor]:
        """All that changes while it learns, for a checkpoint."""

    def restore(self, state: dict[str, Tensor]) -> None:
        """Resume from what `state` gave."""

    def fault(self) -> str | None:
        """What in it is not finite; None where all is."""
