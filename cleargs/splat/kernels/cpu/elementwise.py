"""Kernels that visit each number, pixel or Gaussian once: Adam, affine colour, noise on the means.

Random numbers come from a counter (SplitMix64, Steele et al. 2014) instead of a stream, so that they do not
depend on the number of threads.
"""

from __future__ import annotations

import math

import numpy as np
from numba import prange

from cleargs.splat.kernels.cpu.jit import inlined, kernel
from cleargs.splat.kernels.cpu.projection import dot, scaled_axes, unit_quaternion
from cleargs.types import AnyArray, ArrayF32

ONE = np.float32(1)
BLOCK = 256
"""Gaussians per work item."""
# The constants of SplitMix64.
_GOLDEN = np.uint64(0x9E3779B97F4A7C15)
_FIRST, _SECOND = np.uint64(0xBF58476D1CE4E5B9), np.uint64(0x94D049BB133111EB)
_UNIT = 2.0**-32


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


@inlined
def random_bits(key: np.uint64, count: np.uint64) -> np.uint64:
    """Return 64 random bits: number ``count`` of the sequence with this key."""
    bits = key + (count + np.uint64(1)) * _GOLDEN
    bits = (bits ^ (bits >> np.uint64(30))) * _FIRST
    bits = (bits ^ (bits >> np.uint64(27))) * _SECOND
    return bits ^ (bits >> np.uint64(31))


@inlined
def normal_pair(key: np.uint64, count: np.uint64) -> tuple[float, float]:
    """Return two independent normal numbers (Box and Muller 1958), at most 6.8 standard deviations."""
    bits = random_bits(key, count)
    length = math.sqrt(-2.0 * math.log((np.float64(bits >> np.uint64(32)) + 0.5) * _UNIT))
    turn = 2.0 * math.pi * _UNIT * np.float64(bits & np.uint64(0xFFFFFFFF))
    return length * math.cos(turn), length * math.sin(turn)


@kernel
def add_noise(
    means: ArrayF32,
    log_scales: ArrayF32,
    rotations: ArrayF32,
    logits: ArrayF32,
    amount: float,
    min_opacity: float,
    cut: float,
    key: np.uint64,
) -> None:
    """Add ``amount`` times the covariance times a normal vector to the means [N, 3].

    A sigmoid around the opacity ``min_opacity`` fades the noise out (gsplat's ``inject_noise_to_position``).
    Gaussians with an opacity of ``cut`` or more get none.
    """
    n = means.shape[0]
    for block in prange((n + BLOCK - 1) // BLOCK):
        for g in range(block * BLOCK, min(n, (block + 1) * BLOCK)):
            opacity = 1.0 / (1.0 + math.exp(-np.float64(logits[g])))
            if not opacity < cut:
                continue
            a, b = normal_pair(key, np.uint64(2 * g))
            c, _ = normal_pair(key, np.uint64(2 * g + 1))
            w, x, y, z, _ = unit_quaternion(
                np.float64(rotations[g, 0]),
                np.float64(rotations[g, 1]),
                np.float64(rotations[g, 2]),
                np.float64(rotations[g, 3]),
            )
            sx = math.exp(np.float64(log_scales[g, 0]))
            sy = math.exp(np.float64(log_scales[g, 1]))
            sz = math.exp(np.float64(log_scales[g, 2]))
            m0, m1, m2 = scaled_axes(w, x, y, z, sx, sy, sz)
            fade = amount / (1.0 + math.exp(100.0 * (opacity - min_opacity)))
            d0, d1, d2 = fade * dot(m0, (a, b, c)), fade * dot(m1, (a, b, c)), fade * dot(m2, (a, b, c))
            for axis in range(3):
                means[g, axis] += np.float32(d0 * m0[axis] + d1 * m1[axis] + d2 * m2[axis])
