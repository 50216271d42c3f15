"""A formation model: what a camera does to a sharp image, here a vignette whose strength is learned.

It is given to a training: cg.train(scene, views, config, formation=Vignette()). No setting names it.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from cleargs.splat.camera import Camera
from cleargs.splat.formation import Renderer
from cleargs.splat.types import Render
from cleargs.splat.views import TrainingView


class Vignette:
    """Fulfils `cleargs.splat.formation.Formation`: the photograph is (1 - strength r²) times the render."""

    def __init__(self, strength: float = 0.0, rate: float = 0.05) -> None:
        self.strength, self.rate = strength, rate

    def form(
        self,
        view: TrainingView,
        factor: float,
        progress: float,
        target: Tensor,
        mask: Tensor | None,
        render: Renderer,
    ) -> "VignettedView":
        return VignettedView(self, view.camera.scaled(factor), view.weight)

    def digest(self) -> str:
        return f"vignette {self.strength} {self.rate}"

    def state(self) -> dict[str, Tensor]:
        return {"strength": torch.tensor(self.strength, dtype=torch.float64)}

    def restore(self, state: dict[str, Tensor]) -> None:
        self.strength = float(state["strength"])

    def fault(self) -> str | None:
        return None if abs(self.strength) < 1.0 else "the vignette has run away"


@dataclass
class VignettedView:
    """Fulfils `cleargs.splat.formation.Formed`: one step on one view."""

    vignette: Vignette
    camera: Camera
    weight: float
    needs_depth: bool = False

    def forward(self, render: Render) -> Tensor:
        height, width = render.image.shape[:2]
        y, x = torch.linspace(-1, 1, height)[:, None], torch.linspace(-1, 1, width)[None, :]
        self._image, self._far = render.image, ((x * x + y * y) / 2)[..., None]  # 1 in the corners
        return render.image * (1.0 - self.vignette.strength * self._far)

    def backward(self, gradient: Tensor) -> Tensor:
        # A sum that a parameter depends on: in float64 on one thread, by NumPy, the same for any threads.
        product = (gradient * self._image * self._far).numpy().astype("float64")
        self._slope = -float(product.sum())
        return gradient * (1.0 - self.vignette.strength * self._far)

    def learn(self) -> None:
        self.vignette.strength -= self.vignette.rate * self._slope
