"""Kernels with one pass over numbers or pixels: Adam and affine colour."""

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
    """See ``cleargs.splat.backend.adam_step``."""
    size, (beta1, beta2) = parameter.numel(), ADAM_BETAS
    rates = rate if isinstance(rate, Tensor) else torch.full((1,), rate, device=parameter.device)
    rates = rates.to(parameter.device, torch.float32).reshape(-1)
    adam[(-(-size // NUMBERS_BLOCK),)](
        parameter,
        gradient,
        first,
        second,
        rates,
        size,
        len(rates),
        beta1,
        beta2,
        ADAM_EPSILON,
        1.0 - beta1**step,
        math.sqrt(1.0 - beta2**step),
        num_warps=4,
    )


@triton.jit(do_not_specialize=["pixels"])
def map_pixels(image, affine, output, pixels):
    """Store affine[:, :3] image + affine[:, 3]; images [pixels, 3], affine [3, 4]."""
    i = tl.program_id(0) * device_layout.NUMBERS_BLOCK + tl.arange(0, device_layout.NUMBERS_BLOCK)
    mask = i < pixels
    red = tl.load(image + i * 3, mask=mask, other=0.0)
    green = tl.load(image + i * 3 + 1, mask=mask, other=0.0)
    blue = tl.load(image + i * 3 + 2, mask=mask, other=0.0)
    for channel in tl.static_range(3):
        value = tl.load(affine + channel * 4) * red + tl.load(affine + channel * 4 + 1) * green
        value += tl.load(affine + channel * 4 + 2) * blue + tl.load(affine + channel * 4 + 3)
        tl.store(output + i * 3 + channel, value, mask=mask)


@triton.jit(do_not_specialize=["pixels"])
def map_backward(image, affine, grad_output, grad_image, partials, pixels):
    """Store affine[:, :3]ᵀ grad_output, and each program's part of dL/d(affine): [programs, 12]."""
    i = tl.program_id(0) * device_layout.NUMBERS_BLOCK + tl.arange(0, device_layout.NUMBERS_BLOCK)
    mask = i < pixels
    for source in tl.static_range(3):
        total = tl.zeros_like(i).to(tl.float32)
        for channel in tl.static_range(3):
            g = tl.load(grad_output + i * 3 + channel, mask=mask, other=0.0)
            total += tl.load(affine + channel * 4 + source) * g
            value = tl.load(image + i * 3 + source, mask=mask, other=0.0)
            share = tl.sum(g.to(tl.float64) * value.to(tl.float64), axis=0)
            tl.store(partials + tl.program_id(0) * 12 + channel * 4 + source, share)
        tl.store(grad_image + i * 3 + source, total, mask=mask)
    for channel in tl.static_range(3):
        g = tl.load(grad_output + i * 3 + channel, mask=mask, other=0.0)
        tl.store(partials + tl.program_id(0) * 12 + channel * 4 + 3, tl.sum(g.to(tl.float64), axis=0))


def _on_device(affine: Tensor, image: Tensor) -> Tensor:
    # Without waiting for the device: the source is read before the call returns.
    return affine.detach().float().contiguous().to(image.device, non_blocking=True)


def apply_affine(image: Tensor, affine: Tensor) -> Tensor:
    """See ``cleargs.formation.exposure.apply_affine``."""
    image, affine = image.detach().contiguous(), _on_device(affine, image)
    output = torch.empty_like(image)
    pixels = image.numel() // 3
    map_pixels[(-(-pixels // NUMBERS_BLOCK),)](image, affine, output, pixels, num_warps=4)
    return output


def affine_backward(image: Tensor, affine: Tensor, grad_output: Tensor) -> tuple[Tensor, Tensor]:
    """See ``cleargs.formation.exposure.affine_backward``. Both gradients stay on the device."""
    image, affine = image.detach().contiguous(), _on_device(affine, image)
    grad_image = torch.empty_like(image)
    pixels = image.numel() // 3
    programs = -(-pixels // NUMBERS_BLOCK)
    partials = torch.empty(programs, 12, dtype=torch.float64, device=image.device)
    map_backward[(programs,)](
        image, affine, grad_output.contiguous(), grad_image, partials, pixels, num_warps=4
    )
    return grad_image, partials.sum(0).reshape(3, 4)
