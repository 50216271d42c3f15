"""A model of image formation: a vignette whose strength is learned.

Pass it to a training: cg.train(scene, views, config, formation=Vignette()). No setting selects it.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from cleargs.splat.camera import Camera
from cleargs.splat.formation import Renderer
from cleargs.splat.types import Render
from cleargs.splat.views import TrainingView


class Vignette:
    """A `cleargs.splat.formation.Formation`: the formed image is (1 - strength r²) times the render."""

    def __init__(self, strength: float = 0.0, rate: float = 0.05) -> None:
        self.strength, self.rate = strength, rate

    def form(
        self,
        view: TrainingView,
        factor: float,
        progress: float,
        observed: Tensor,
        mask: Tensor | None,
        render: Renderer,
    ) -> "VignettedView":
        return VignettedView(self, view.camera.scaled(factor), view.weight, mask)

    def digest(self) -> str:
        return f"vignette {self.strength} {self.rate}"

    def state(self) -> dict[str, Tensor]:
        return {"strength": torch.tensor(self.strength, dtype=torch.float64)}

    def restore(self, state: dict[str, Tensor]) -> None:
        self.strength = float(state["strength"])

    def fault(self) -> str | None:
        return None if abs(self.strength) < 1.0 else "the strength of the vignette diverged"


@dataclass
class VignettedView:
    """A `cleargs.splat.formation.Formed`: one training step on one view."""

    vignette: Vignette
    camera: Camera
    weight: float
    mask: Tensor | None
    needs_depth: bool = False

    def forward(self, render: Render) -> Tensor:
        height, width = render.image.shape[:2]
        y, x = torch.linspace(-1, 1, height)[:, None], torch.linspace(-1, 1, width)[None, :]
        self._image, self._far = render.image, ((x * x + y * y) / 2)[..., None]  # 1 in the corners
        return render.image * (1.0 - self.vignette.strength * self._far)

    def backward(self, gradient: Tensor) -> Tensor:
        # NumPy sums in float64 on one thread, so the result does not depend on the number of threads.
        product = (gradient * self._image * self._far).numpy().astype("float64")
        self._slope = -float(product.sum())
        return gradient * (1.0 - self.vignette.strength * self._far)

    def learn(self) -> None:
        self.vignette.strength -= self.vignette.rate * self._slope
