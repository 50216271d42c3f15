"""Kernels that visit each number or pixel once: Adam and affine colour."""

from __future__ import annotations

import math

import numpy as np
from numba import prange

from cleargs.splat.kernels.cpu.jit import kernel
from cleargs.types import AnyArray, ArrayF32

ONE = np.float32(1)


@kernel
def adam(
    parameter: ArrayF32,
    gradient: ArrayF32,
    first: ArrayF32,
    second: ArrayF32,
    rates: ArrayF32,
    beta1: np.float32,
    beta2: np.float32,
    epsilon: np.float32,
    root_correction: np.float32,
) -> None:
    """Update ``parameter`` [n] and its moments [n] in place by a step of Adam (Kingma and Ba 2015).

    ``rates`` are the learning rates of one block (a work item), divided by 1 - beta1^t. They are the same for
    every block. ``root_correction`` is sqrt(1 - beta2^t).
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


@kernel
def apply_affine(image: ArrayF32, affine: ArrayF32, output: ArrayF32) -> None:
    """Write affine[:, :3] image + affine[:, 3] for every pixel; images [H, W, 3], affine [3, 4]."""
    height, width, _ = image.shape
    for y in prange(height):
        for x in range(width):
            red, green, blue = image[y, x, 0], image[y, x, 1], image[y, x, 2]
            for channel in range(3):
                row = affine[channel]
                output[y, x, channel] = row[0] * red + row[1] * green + row[2] * blue + row[3]


@kernel
def affine_backward(
    image: ArrayF32, affine: ArrayF32, grad_output: ArrayF32, grad_image: ArrayF32, row_sums: AnyArray
) -> None:
    """Write affine[:, :3]ᵀ grad_output, and each row's share of dL/d(affine), [H, 3, 4] float64."""
    height, width, _ = image.shape
    for y in prange(height):
        row_sums[y] = 0.0
        for x in range(width):
            for source in range(3):
                total = affine[0, source] * grad_output[y, x, 0]
                total += affine[1, source] * grad_output[y, x, 1]
                total += affine[2, source] * grad_output[y, x, 2]
                grad_image[y, x, source] = total
            for channel in range(3):
                g = grad_output[y, x, channel]
                for source in range(3):
                    row_sums[y, channel, source] += g * image[y, x, source]
                row_sums[y, channel, 3] += g
