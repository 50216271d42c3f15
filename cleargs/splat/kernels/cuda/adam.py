"""One Adam step over a flat parameter, everything fused into one pass over memory."""

from __future__ import annotations

import math

import torch
import triton
import triton.language as tl
from torch import Tensor

from cleargs.splat.types import AdamStep

BLOCK = 1024


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
    BLOCK: tl.constexpr,
):
    """Update ``parameter`` [size] and its moments in place; element i has the rate ``rates[i % columns]``.

    ``correction`` is 1 - beta1^t, ``root_correction`` sqrt(1 - beta2^t).
    """
    i = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
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


def adam_step(step: AdamStep) -> None:
    """Do one step of tensors on a GPU."""
    size, rates = step.parameter.numel(), step.rate
    if not isinstance(rates, Tensor):
        rates = torch.full((1,), rates, device=step.parameter.device)
    rates = rates.to(step.parameter.device, torch.float32).reshape(-1)
    beta1, beta2 = step.betas
    adam[(-(-size // BLOCK),)](
        *step.tensors,
        rates,
        size,
        len(rates),
        beta1,
        beta2,
        step.epsilon,
        1.0 - beta1**step.number,
        math.sqrt(1.0 - beta2**step.number),
        BLOCK=BLOCK,
        num_warps=4,
    )
