"""Data types that the training exchanges with the kernels."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from cleargs.splat.gaussians import Gaussians


class Render(NamedTuple):
    """A rendered view."""

    image: Tensor  # [H, W, 3] sRGB, at least 0, may exceed 1
    alpha: Tensor  # [H, W] 1 - final transmittance
    depth: Tensor | None  # [H, W] sum of weight * camera z, not divided by alpha; None: not requested


class Rates(NamedTuple):
    """Learning rates of a step by parameter."""

    means: float
    log_scales: float
    rotations: float
    logit_opacities: float
    sh: float  # rate of the constant term
    sh_rest: float  # rate of the other terms


class Reading(NamedTuple):
    """Measurements of a training step."""

    loss: float  # weighted, without regularisation
    l1: float  # mean absolute error, sRGB in [0, 1]
    ssim: float
    psnr: float  # dB


def group(state: dict[str, Tensor], prefix: str) -> dict[str, Tensor]:
    """Return the tensors whose names start with ``prefix``: rest of the name -> tensor."""
    return {name.removeprefix(prefix): t for name, t in state.items() if name.startswith(prefix)}


@dataclass
class Moments:
    """Running means of Adam by parameter name: of the gradients (first) and of their squares (second)."""

    first: dict[str, Tensor]
    second: dict[str, Tensor]

    @classmethod
    def zeros(cls, gaussians: Gaussians) -> Moments:
        """Return moments of zero for these parameters."""
        tensors = gaussians.tensors()
        return cls(
            {name: torch.zeros_like(tensor) for name, tensor in tensors.items()},
            {name: torch.zeros_like(tensor) for name, tensor in tensors.items()},
        )

    @classmethod
    def of_state(cls, state: dict[str, Tensor]) -> Moments:
        """Return the moments in a training state, which may hold other tensors as well."""
        return cls(group(state, "first."), group(state, "second."))

    def state(self) -> dict[str, Tensor]:
        """Return the moments as tensors of a training state, named ``first.NAME`` and ``second.NAME``."""
        return {
            f"{prefix}.{name}": tensor
            for prefix, group in (("first", self.first), ("second", self.second))
            for name, tensor in group.items()
        }

    def to(self, device: torch.device) -> Moments:
        """Return a copy on a device."""
        first, second = (
            {name: tensor.to(device, copy=True) for name, tensor in group.items()}
            for group in (self.first, self.second)
        )
        return Moments(first, second)
