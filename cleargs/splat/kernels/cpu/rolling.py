"""The pose of the camera for each Gaussian under a rolling shutter: see `cleargs.splat.rolling`."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import prange

from cleargs.splat.constants import NEAR
from cleargs.splat.kernels.cpu.jit import inlined, kernel
from cleargs.splat.rolling import BEYOND, STEEPEST, STEPS, seen_at
from cleargs.types import AnyArray, ArrayF32, ArrayF64

BLOCK = 128
"""Gaussians per work item; fixed, so that nothing depends on the number of threads."""
_seen_at = inlined(seen_at)


@inlined
def _bounded(value: float, limit: float) -> float:
    value = limit if value > limit else value
    return -limit if value < -limit else value


@inlined
def _depth_of(z: float) -> float:
    return z if z > NEAR else NEAR


@inlined
def _gain(slope: float, seen: Any, speed: Any, ratio: float, along: int) -> float:
    change = speed[0] if along == 0 else speed[1]
    return _bounded(slope / _depth_of(seen[2]) * (change - ratio * speed[2]), STEEPEST)


@kernel
def own_poses(
    means: ArrayF32,  # [N, 3]
    w: ArrayF64,  # [3, 4] world to camera
    twists: Any,  # three tuples of six floats
    slope: float,
    start: float,
    along: int,  # 0 if columns are read, 1 if rows are
    out: AnyArray,  # [N, 12] float64, written
) -> None:
    """Write the three rows of each Gaussian's linear map and its shift."""
    pose, first, second = twists
    count = means.shape[0]
    for block in prange((count + BLOCK - 1) // BLOCK):
        begin = block * BLOCK
        size = min(BLOCK, count - begin)
        # One loop per step, so that LLVM vectorises the search for the places.
        still_x, still_y, still_z, places = np.empty(BLOCK), np.empty(BLOCK), np.empty(BLOCK), np.empty(BLOCK)
        for n in range(size):
            x, y, z = means[begin + n, 0], means[begin + n, 1], means[begin + n, 2]
            still_x[n] = w[0, 0] * x + w[0, 1] * y + w[0, 2] * z + w[0, 3]
            still_y[n] = w[1, 0] * x + w[1, 1] * y + w[1, 2] * z + w[1, 3]
            still_z[n] = w[2, 0] * x + w[2, 1] * y + w[2, 2] * z + w[2, 3]
        for n in range(size):
            x, y, z = still_x[n], still_y[n], still_z[n]
            place = _bounded(slope * (x if along == 0 else y) / _depth_of(z) + start, BEYOND)
            for _ in range(STEPS):
                _, seen, speed = _seen_at(pose, first, second, place, x, y, z)
                ratio = (seen[0] if along == 0 else seen[1]) / _depth_of(seen[2])
                error = place - _bounded(slope * ratio + start, BEYOND)
                place = _bounded(place - error / (1.0 - _gain(slope, seen, speed, ratio, along)), BEYOND)
            places[n] = place
        for n in range(size):
            g, place = begin + n, places[n]
            turn, seen, speed = _seen_at(pose, first, second, place, still_x[n], still_y[n], still_z[n])
            depth = _depth_of(seen[2])
            ratio = (seen[0] if along == 0 else seen[1]) / depth
            rate = 0.0
            if abs(place) < BEYOND:
                rate = slope / depth / (1.0 - _gain(slope, seen, speed, ratio, along))
            row = turn[0] if along == 0 else turn[1]
            by_x = rate * (row[0] - ratio * turn[2][0])
            by_y = rate * (row[1] - ratio * turn[2][1])
            by_z = rate * (row[2] - ratio * turn[2][2])
            for i in range(3):
                own_x = turn[i][0] + speed[i] * by_x
                own_y = turn[i][1] + speed[i] * by_y
                own_z = turn[i][2] + speed[i] * by_z
                shift = seen[i]
                for j in range(3):
                    number = own_x * w[0, j] + own_y * w[1, j] + own_z * w[2, j]
                    out[g, 3 * i + j] = number
                    shift -= number * means[g, j]
                out[g, 9 + i] = shift
