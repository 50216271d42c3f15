"""What the training and both back ends hand each other."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from cleargs.errors import InputError
from cleargs.splat.gaussians import Gaussians


class Render(NamedTuple):
    """One rendered view."""

    image: Tensor  # [H, W, 3] sRGB; not clamped above
    alpha: Tensor  # [H, W] 1 - final transmittance
    depth: Tensor | None  # [H, W] accumulated: the sum of weight * camera z, not divided by alpha


class PhotometricLoss(NamedTuple):
    """weight * ((1 - lambda) l1 + lambda (1 - ssim)) and its gradient; l1 and ssim are unweighted means."""

    loss: float
    grad_image: Tensor  # [H, W, 3]
    l1: float
    ssim: float


class Reading(NamedTuple):
    """What a step measured."""

    loss: float
    l1: float
    ssim: float
    psnr: float


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

        def group(prefix: str) -> dict[str, Tensor]:
            return {name.removeprefix(prefix): t for name, t in state.items() if name.startswith(prefix)}

        return cls(group("first."), group("second."))

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


@dataclass(frozen=True, eq=False)
class AdamStep:
    """One dense step of Adam (Kingma and Ba 2015); parameter and moments are updated in place.

    The same arithmetic as ``torch.optim.Adam`` without weight decay:
    p -= rate / (1 - b1^t) m / (sqrt(v) / sqrt(1 - b2^t) + epsilon).

    Raises InputError when the tensors do not fit together.
    """

    parameter: Tensor
    gradient: Tensor
    first: Tensor
    second: Tensor
    """Contiguous float32, all four of one shape and on one device."""
    number: int
    """The step t, counted from 1."""
    rate: float | Tensor
    """One rate, or a tensor with one rate per column of ``parameter.reshape(len(parameter), -1)``."""
    betas: tuple[float, float] = (0.9, 0.999)
    epsilon: float = 1e-15

    def __post_init__(self) -> None:
        tensors, parameter = self.tensors, self.parameter
        for tensor in tensors:
            if (
                tensor.shape != parameter.shape
                or not tensor.is_contiguous()
                or tensor.device != parameter.device
            ):
                raise InputError(
                    f"Adam got tensors of the shapes {[tuple(t.shape) for t in tensors]} "
                    f"on {sorted({str(t.device) for t in tensors})}",
                    hint="give four contiguous tensors of one shape, all on the CPU or all on one GPU",
                )
        given = self.rate.numel() if isinstance(self.rate, Tensor) else 1
        if parameter.numel() and given not in (1, self.columns):
            raise InputError(
                f"{given} learning rates for {self.columns} columns", hint="give one, or one per column"
            )

    @property
    def tensors(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Parameter, gradient and both moments."""
        return self.parameter, self.gradient, self.first, self.second

    @property
    def columns(self) -> int:
        """Numbers per row of the parameter, which has rows."""
        return self.parameter.numel() // len(self.parameter)
