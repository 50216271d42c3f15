"""Adam (Kingma and Ba 2015) in place, one fused kernel per parameter."""

from __future__ import annotations

import math

import numpy as np
from torch import Tensor

from cleargs.errors import InputError
from cleargs.splat.kernels.cuda import support

BLOCK = 4096
"""Elements per work item, about."""


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
        if (
            tensor.shape != parameter.shape
            or not tensor.is_contiguous()
            or tensor.device != parameter.device
            or tensor.device.type not in ("cpu", "cuda")
        ):
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
    if support.on_gpu(parameter.device):
        from cleargs.splat.kernels.cuda import adam as gpu_adam

        rates_on_gpu = gpu_adam.rates_tensor(lr, parameter.device)
        gpu_adam.adam_step(*tensors, rates_on_gpu, step=step, betas=betas, eps=eps)
        return
    from cleargs.splat.kernels.cpu import adam, launch

    rates = np.asarray(lr, np.float64).reshape(-1)
    beta1, beta2 = betas
    corrected = np.broadcast_to(rates / (1.0 - beta1**step), (columns,)).astype(np.float32)
    flat = [tensor.detach().view(-1).numpy() for tensor in tensors]
    with launch.exclusive():
        adam.adam(
            flat[0],
            flat[1],
            flat[2],
            flat[3],
            np.tile(corrected, max(1, BLOCK // columns)),
            np.float32(beta1),
            np.float32(beta2),
            np.float32(eps),
            np.float32(math.sqrt(1.0 - beta2**step)),
        )
