"""What the training and both back ends hand each other."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from cleargs.splat.gaussians import Gaussians


class Render(NamedTuple):
    """One rendered view."""

    image: Tensor  # [H, W, 3] sRGB; not clamped above
    alpha: Tensor  # [H, W] 1 - final transmittance
    depth: Tensor | None  # [H, W] accumulated: the sum of weight * camera z, not divided by alpha


Rate = float | Tensor
"""One learning rate, or one per column of a parameter."""


class Reading(NamedTuple):
    """What a step measured."""

    loss: float
    l1: float
    ssim: float
    psnr: float


def group(state: dict[str, Tensor], prefix: str) -> dict[str, Tensor]:
    """The tensors of ``state`` whose names begin with ``prefix``, by the rest of their names."""
    return {name.removeprefix(prefix): t for name, t in state.items() if name.startswith(prefix)}


@dataclass
class Moments:
    """Adam's running means of the gradients and of their squares, by parameter name."""

    first: dict[str, Tensor]
    second: dict[str, Tensor]

    @classmethod
    def zeros(cls, gaussians: Gaussians) -> Moments:
        """Fresh moments for these parameters."""
        tensors = gaussians.tensors()
        return cls(
            {name: torch.zeros_like(tensor) for name, tensor in tensors.items()},
            {name: torch.zeros_like(tensor) for name, tensor in tensors.items()},
        )

    @classmethod
    def of_state(cls, state: dict[str, Tensor]) -> Moments:
        """Those that `state` gave, among whatever else is in ``state``."""
        return cls(group(state, "first."), group(state, "second."))

    def state(self) -> dict[str, Tensor]:
        """Them for a ``state.safetensors``, by ``first.NAME`` and ``second.NAME``."""
        return {
            f"{prefix}.{name}": tensor
            for prefix, group in (("first", self.first), ("second", self.second))
            for name, tensor in group.items()
        }

    def to(self, device: torch.device) -> Moments:
        """A copy of them on a device."""
        first, second = (
            {name: tensor.to(device, copy=True) for name, tensor in group.items()}
            for group in (self.first, self.second)
        )
        return Moments(first, second)
