"""One Adam step over a flat parameter, everything fused into one pass over memory."""

from __future__ import annotations

import math

import numpy as np
from numba import prange

from cleargs.splat.kernels.cpu.jit import Floats, kernel

ONE = np.float32(1)


@kernel
def adam(
    parameter: Floats,
    gradient: Floats,
    first: Floats,
    second: Floats,
    rates: Floats,
    beta1: np.float32,
    beta2: np.float32,
    epsilon: np.float32,
    root_correction: np.float32,
) -> None:
    """Update ``parameter`` [n] and its moments [n] in place.

    ``rates`` holds the step sizes of one block, already divided by 1 - beta1^t, and is used again for
    every block of that length; ``root_correction`` is sqrt(1 - beta2^t). The block is the unit of work,
    so that the arithmetic of an element does not depend on the number of threads.
    """
    n, block = parameter.shape[0], rates.shape[0]
    for index in prange((n + block - 1) // block):
        start = index * block
        for j in range(min(block, n - start)):
            i = np.uint64(start + j)
            g = gradient[i]
            m = beta1 * first[i] + (ONE - beta1) * g
            v = beta2 * second[i] + (ONE - beta2) * g * g
            first[i] = m
            second[i] = v
            parameter[i] -= rates[np.uint64(j)] * m / (np.float32(math.sqrt(v)) / root_correction + epsilon)
