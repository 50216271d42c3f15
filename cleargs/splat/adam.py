"""Adam (Kingma and Ba 2015) in place, one fused kernel per parameter: its moments, and its steps."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from cleargs.errors import InputError
from cleargs.splat.backend import backend_for
from cleargs.splat.gaussians import Gaussians


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


def step_gaussians(
    gaussians: Gaussians,
    gradients: Gaussians,
    moments: Moments,
    rates: dict[str, float | Tensor],
    *,
    step: int,
) -> None:
    """One Adam step of every group in place; ``step`` counts from 1 (bias correction)."""
    slopes = gradients.tensors()
    for name, parameter in gaussians.tensors().items():
        adam_step(
            parameter, slopes[name], moments.first[name], moments.second[name], step=step, lr=rates[name]
        )


def adam_step(
    parameter: Tensor,
    gradient: Tensor,
    first_moment: Tensor,
    second_moment: Tensor,
    *,
    step: int,
    lr: float | Tensor,
    betas: tuple[float, float] = (0.9, 0.999),
    eps: float = 1e-15,
) -> None:
    """One dense Adam step, ``parameter`` and the moments updated in place.

    The four tensors are contiguous float32 of one shape on one device; ``step`` counts from 1. ``lr`` is one
    rate, or a tensor with one rate per column of ``parameter.reshape(len(parameter), -1)``. Same arithmetic
    as ``torch.optim.Adam`` without weight decay: p -= lr / (1 - b1^t) m / (sqrt(v) / sqrt(1 - b2^t) + eps).

    Raises:
        InputError: when the tensors do not fit together.
    """
    tensors = (parameter, gradient, first_moment, second_moment)
    for tensor in tensors:
        if tensor.shape != parameter.shape or not tensor.is_contiguous() or tensor.device != parameter.device:
            raise InputError(
                f"Adam got tensors of the shapes {[tuple(t.shape) for t in tensors]} "
                f"on {sorted({str(t.device) for t in tensors})}",
                hint="give four contiguous tensors of one shape, all on the CPU or all on one GPU",
            )
    if parameter.numel() == 0:
        return
    columns = parameter.numel() // len(parameter)
    given = lr.numel() if isinstance(lr, Tensor) else 1
    if given not in (1, columns):
        raise InputError(f"{given} learning rates for {columns} columns", hint="give one, or one per column")
    backend_for(parameter.device).adam_step(*tensors, step=step, lr=lr, betas=betas, eps=eps)
