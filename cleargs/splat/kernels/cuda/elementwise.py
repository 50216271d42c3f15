"""Adam and the affine colour on the GPU."""

from __future__ import annotations

import math

import torch
import triton
import triton.language as tl
from torch import Tensor

from cleargs.splat.constants import ADAM_BETAS, ADAM_EPSILON
from cleargs.splat.kernels.cuda import device_layout
from cleargs.splat.kernels.cuda.device_layout import NUMBERS_BLOCK
from cleargs.splat.types import Rate


@triton.jit(do_not_specialize=["size", "columns"])
def adam(
    parameter,
    gradient,
    first,
    second,
    rates,
    size,
    columns,
    beta1,
    beta2,
    epsilon,
    correction,
    root_correction,
):
    """Update ``parameter`` [size] and its moments in place (Kingma and Ba 2015).

    Element i has the learning rate ``rates[i % columns]``. ``correction`` is 1 - beta1^t, ``root_correction``
    is sqrt(1 - beta2^t).
    """
    i = tl.program_id(0).to(tl.int64) * device_layout.NUMBERS_BLOCK + tl.arange(
        0, device_layout.NUMBERS_BLOCK
    )
    mask = i < size
    g = tl.load(gradient + i, mask=mask, other=0.0)
    m = beta1 * tl.load(first + i, mask=mask, other=0.0) + (1.0 - beta1) * g
    v = beta2 * tl.load(second + i, mask=mask, other=0.0) + (1.0 - beta2) * g * g
    tl.store(first + i, m, mask=mask)
    tl.store(second + i, v, mask=mask)
    rate = tl.load(rates + i % columns, mask=mask, other=0.0) / correction
    value = tl.load(parameter + i, mask=mask, other=0.0)
    value -= rate * m / (tl.sqrt(v) / root_correction + epsilon)
    tl.store(parameter + i, value, mask=mask)


def adam_step(
    parameter: Tensor, gradient: Tensor, first: Tensor, second: Tensor, step: int, rate: Rate
) -> None:
    size, (beta1, beta2) = parameter.numel(), ADAM_BETAS
    rates = rate if isinstance(rate, Tensor) else torch.full((1,), rate, device=parameter.device)
    rates = rates.to(parameter.device, torch.float32).reshape(-1)
    corrections = 1.0 - beta1**step, math.sqrt(1.0 - beta2**step)
    adam[(-(-size // NUMBERS_BLOCK),)](
        *(parameter, gradient, first, second, rates, size, len(rates)),
        *(beta1, beta2, ADAM_EPSILON, *corrections),
        num_warps=4,
    )


def apply_affine(image: Tensor, affine: Tensor) -> Tensor:
    affine = _on_device(affine, image)
    return image.detach() @ affine[:, :3].T + affine[:, 3]


def affine_backward(image: Tensor, affine: Tensor, grad_output: Tensor) -> tuple[Tensor, Tensor]:
    """Return both gradients on the device: see ``cleargs.splat.backend.Backend``."""
    colours = torch.nn.functional.pad(image.detach().double(), (0, 1), value=1.0)  # [H, W, 4]
    # One channel at a time: torch sums in a fixed order, which a matrix product does not guarantee.
    sums = [(grad_output[..., channel, None] * colours).sum(dim=(0, 1)) for channel in range(3)]
    return grad_output @ _on_device(affine, image)[:, :3], torch.stack(sums)


def _on_device(affine: Tensor, image: Tensor) -> Tensor:
    # Without waiting for the device: the source is read before the call returns.
    return affine.detach().float().to(image.device, non_blocking=True)
