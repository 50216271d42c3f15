"""Noise on the means of the Gaussians (Kheradmand et al. 2024).

Random numbers come from a counter (SplitMix64, Steele et al. 2014) instead of a stream, so that they do not
depend on the number of threads. As in ``projection``, the arithmetic is vector code.
"""

from __future__ import annotations

import math

import numpy as np
from numba import prange

from cleargs.splat.kernels.cpu.jit import kernel, unfused
from cleargs.splat.kernels.cpu.lane_math import GROUP, exp, log2
from cleargs.splat.kernels.cpu.projection import BLOCK, dot, lane_quaternion, scaled_axes
from cleargs.types import AnyArray, ArrayF32

# The constants of SplitMix64.
_GOLDEN = np.uint64(0x9E3779B97F4A7C15)
_FIRST, _SECOND = np.uint64(0xBF58476D1CE4E5B9), np.uint64(0x94D049BB133111EB)
_UNIT = 2.0**-32
_LN2 = math.log(2.0)
# Taylor series of -cos(2 pi t) in t² and of -sin(2 pi t) / t, which are exact to 1e-9 for |t| <= 1/2.
_COSINE = tuple(-((-1) ** n) * (2 * math.pi) ** (2 * n) / math.factorial(2 * n) for n in range(10, -1, -1))
_SINE = tuple(
    -((-1) ** n) * (2 * math.pi) ** (2 * n + 1) / math.factorial(2 * n + 1) for n in range(10, -1, -1)
)
_OPACITY, _ROTATION, _LOG_SCALES, _MOVE, _ROWS = 0, 1, 5, 8, 11
"""Rows of the scratch memory."""


@unfused
def random_bits(key: np.uint64, count: np.uint64) -> np.uint64:
    """Return 64 random bits: number ``count`` of the sequence with this key."""
    bits = key + (count + np.uint64(1)) * _GOLDEN
    bits = (bits ^ (bits >> np.uint64(30))) * _FIRST
    bits = (bits ^ (bits >> np.uint64(27))) * _SECOND
    return bits ^ (bits >> np.uint64(31))


@unfused
def normal_pair(key: np.uint64, count: np.uint64) -> tuple[float, float]:
    """Return two independent normal numbers (Box and Muller 1958), at most 6.8 standard deviations."""
    bits = random_bits(key, count)
    length = math.sqrt(-2.0 * _LN2 * log2((np.float64(bits >> np.uint64(32)) + 0.5) * _UNIT))
    turn = _UNIT * np.float64(bits & np.uint64(0xFFFFFFFF)) - 0.5
    cosine = sine = 0.0
    for coefficient in _COSINE:
        cosine = cosine * (turn * turn) + coefficient
    for coefficient in _SINE:
        sine = sine * (turn * turn) + coefficient
    return length * cosine, length * sine * turn


@unfused
def move_lanes(rows: AnyArray, ids: AnyArray, amount: float, min_opacity: float, key: np.uint64) -> None:
    """Write the move of the mean of each lane."""
    for lane in range(GROUP):
        a, b = normal_pair(key, np.uint64(2) * ids[lane])
        c, _ = normal_pair(key, np.uint64(2) * ids[lane] + np.uint64(1))
        w, x, y, z, _ = lane_quaternion(rows, _ROTATION, lane)
        sx, sy = exp(rows[_LOG_SCALES, lane]), exp(rows[_LOG_SCALES + 1, lane])
        m0, m1, m2 = scaled_axes(w, x, y, z, sx, sy, exp(rows[_LOG_SCALES + 2, lane]))
        fade = amount / (1.0 + exp(100.0 * (rows[_OPACITY, lane] - min_opacity)))
        d0, d1, d2 = fade * dot(m0, (a, b, c)), fade * dot(m1, (a, b, c)), fade * dot(m2, (a, b, c))
        for axis in range(3):
            rows[_MOVE + axis, lane] = d0 * m0[axis] + d1 * m1[axis] + d2 * m2[axis]


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
        begin, end = block * BLOCK, min(n, (block + 1) * BLOCK)
        rows, ids = np.empty((_ROWS, GROUP)), np.empty(GROUP, np.uint64)
        found, opacities = np.empty(BLOCK, np.int64), np.empty(BLOCK)
        for i in range(BLOCK):
            opacities[i] = 1.0 / (1.0 + exp(-np.float64(logits[min(begin + i, end - 1)])))
        count = 0
        for g in range(begin, end):
            found[count] = g
            count += opacities[g - begin] < cut
        for first in range(0, count, GROUP):
            for lane in range(GROUP):
                g = found[min(first + lane, count - 1)]
                ids[lane] = g
                rows[_OPACITY, lane] = opacities[g - begin]
                for part in range(4):
                    rows[_ROTATION + part, lane] = rotations[g, part]
                for axis in range(3):
                    rows[_LOG_SCALES + axis, lane] = log_scales[g, axis]
            move_lanes(rows, ids, amount, min_opacity, key)
            for lane in range(min(GROUP, count - first)):
                for axis in range(3):
                    means[found[first + lane], axis] += np.float32(rows[_MOVE + axis, lane])
