"""Adam and the affine colour on the GPU."""

from __future__ import annotations

import math

import torch
import triton
import triton.language as tl
from torch import Tensor

from cleargs.splat.constants import ADAM_BETAS, ADAM_EPSILON
from cleargs.splat.gaussians import Gaussians
from cleargs.splat.kernels.cuda import device_layout
from cleargs.splat.kernels.cuda.device_layout import NUMBERS_BLOCK
from cleargs.splat.types import Moments, Rates


@triton.jit
def numbers(program, size):
    """Return the numbers that a program handles, and the mask of those below ``size``."""
    i = program.to(tl.int64) * device_layout.NUMBERS_BLOCK + tl.arange(0, device_layout.NUMBERS_BLOCK)
    return i, i < size


@triton.jit
def read(parameter, gradient, at):
    """Return a parameter and its gradient at the `numbers` ``at``."""
    return tl.load(parameter + at[0], mask=at[1], other=0.0), tl.load(gradient + at[0], mask=at[1], other=0.0)


@triton.jit
def update(at, parameter, value, gradient, first, second, rate, weights):
    """Update a parameter, which has this value at the `numbers` ``at``, and its moments.

    ``rate`` is the learning rate over 1 - beta1^t. ``weights`` are beta1, beta2, epsilon, sqrt(1 - beta2^t).
    """
    i, mask = at
    beta1, beta2, epsilon, root_correction = weights
    m = beta1 * tl.load(first + i, mask=mask, other=0.0) + (1.0 - beta1) * gradient
    v = beta2 * tl.load(second + i, mask=mask, other=0.0) + (1.0 - beta2) * gradient * gradient
    tl.store(first + i, m, mask=mask)
    tl.store(second + i, v, mask=mask)
    value -= rate * m / (tl.sqrt(v) / root_correction + epsilon)
    tl.store(parameter + i, value, mask=mask)


@triton.jit(do_not_specialize=["n"])
def adam(
    means,
    log_scales,
    rotations,
    logits,
    sh,
    grad_means,
    grad_log_scales,
    grad_rotations,
    grad_logits,
    grad_sh,
    first_means,
    first_log_scales,
    first_rotations,
    first_logits,
    first_sh,
    second_means,
    second_log_scales,
    second_rotations,
    second_logits,
    second_sh,
    n,
    rate_means,
    rate_log_scales,
    rate_rotations,
    rate_logits,
    rate_sh,
    rate_sh_rest,
    beta1,
    beta2,
    epsilon,
    root_correction,
    by_opacity,
    by_scale,
    COLUMNS: tl.constexpr,
):
    """Update the parameters of ``n`` Gaussians, with ``COLUMNS`` = 3 K SH coefficients each, and the moments.

    A program handles numbers of one parameter. The gradients are those given, plus those of ``by_opacity``
    times the sum of all opacities and ``by_scale`` times the sum of all scales.
    """
    weights = (beta1, beta2, epsilon, root_correction)
    program = tl.program_id(0)
    threes = tl.cdiv(3 * n, device_layout.NUMBERS_BLOCK)
    fours = tl.cdiv(4 * n, device_layout.NUMBERS_BLOCK)
    ones = tl.cdiv(n, device_layout.NUMBERS_BLOCK)
    if program < threes:
        at = numbers(program, 3 * n)
        value, gradient = read(means, grad_means, at)
        update(at, means, value, gradient, first_means, second_means, rate_means, weights)
    elif program < 2 * threes:
        at = numbers(program - threes, 3 * n)
        value, gradient = read(log_scales, grad_log_scales, at)
        gradient += tl.where(by_scale > 0.0, by_scale * tl.exp(value), 0.0)
        first, second = first_log_scales, second_log_scales
        update(at, log_scales, value, gradient, first, second, rate_log_scales, weights)
    elif program < 2 * threes + fours:
        at = numbers(program - 2 * threes, 4 * n)
        value, gradient = read(rotations, grad_rotations, at)
        update(at, rotations, value, gradient, first_rotations, second_rotations, rate_rotations, weights)
    elif program < 2 * threes + fours + ones:
        at = numbers(program - 2 * threes - fours, n)
        value, gradient = read(logits, grad_logits, at)
        opacity = 1.0 / (1.0 + tl.exp(-value))
        gradient += by_opacity * opacity * (1.0 - opacity)
        update(at, logits, value, gradient, first_logits, second_logits, rate_logits, weights)
    else:
        at = numbers(program - 2 * threes - fours - ones, n.to(tl.int64) * COLUMNS)
        value, gradient = read(sh, grad_sh, at)
        rate = tl.where(at[0] % COLUMNS < 3, rate_sh, rate_sh_rest)
        update(at, sh, value, gradient, first_sh, second_sh, rate, weights)


def step_gaussians(
    gaussians: Gaussians,
    gradients: Gaussians,
    moments: Moments,
    rates: Rates,
    *,
    step: int,
    opacity: float,
    scale: float,
) -> None:
    """See ``cleargs.splat.backend.Backend``. One launch updates all parameters."""
    n, (beta1, beta2), parameters = gaussians.num, ADAM_BETAS, gaussians.tensors()
    if n == 0:
        return
    programs = sum(-(-parameter.numel() // NUMBERS_BLOCK) for parameter in parameters.values())
    adam[(programs,)](
        *(*parameters.values(), *gradients.tensors().values()),
        *(running[name] for running in (moments.first, moments.second) for name in parameters),
        *(n, *(rate / (1.0 - beta1**step) for rate in rates)),
        *(beta1, beta2, ADAM_EPSILON, math.sqrt(1.0 - beta2**step)),
        *(opacity / n, scale / (3 * n)),
        COLUMNS=gaussians.sh.shape[1] * 3,
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
