"""The pose of the camera for each Gaussian under a rolling shutter: see `cleargs.splat.rolling`."""

from __future__ import annotations

from typing import Any

from numba import prange

from cleargs.splat.constants import NEAR
from cleargs.splat.kernels.cpu.jit import device, kernel
from cleargs.splat.kernels.cpu.projection import BLOCK
from cleargs.splat.rolling import BEYOND, STEEPEST, STEPS, seen_at
from cleargs.types import AnyArray, ArrayF32, ArrayF64

_seen_at = device(seen_at)


@device
def _bounded(value: float, limit: float) -> float:
    return min(max(value, -limit), limit)


@device
def _place_of(slope: float, start: float, seen: Any, along: int) -> float:
    across = seen[0] if along == 0 else seen[1]
    return _bounded(slope * across / max(seen[2], NEAR) + start, BEYOND)


@device
def _gain(slope: float, seen: Any, speed: Any, along: int) -> float:
    depth = max(seen[2], NEAR)
    across, change = (seen[0], speed[0]) if along == 0 else (seen[1], speed[1])
    return _bounded(slope / depth * (change - across / depth * speed[2]), STEEPEST)


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
        for g in range(block * BLOCK, min(count, (block + 1) * BLOCK)):
            x, y, z = means[g, 0], means[g, 1], means[g, 2]
            still_x = w[0, 0] * x + w[0, 1] * y + w[0, 2] * z + w[0, 3]
            still_y = w[1, 0] * x + w[1, 1] * y + w[1, 2] * z + w[1, 3]
            still_z = w[2, 0] * x + w[2, 1] * y + w[2, 2] * z + w[2, 3]
            place = _place_of(slope, start, (still_x, still_y, still_z), along)
            for _ in range(STEPS):
                _, seen, speed = _seen_at(pose, first, second, place, still_x, still_y, still_z)
                error = place - _place_of(slope, start, seen, along)
                place = _bounded(place - error / (1.0 - _gain(slope, seen, speed, along)), BEYOND)
            turn, seen, speed = _seen_at(pose, first, second, place, still_x, still_y, still_z)
            depth = max(seen[2], NEAR)
            rate = 0.0
            if abs(place) < BEYOND:
                rate = slope / depth / (1.0 - _gain(slope, seen, speed, along))
            across, row = (seen[0], turn[0]) if along == 0 else (seen[1], turn[1])
            by_x = rate * (row[0] - across / depth * turn[2][0])
            by_y = rate * (row[1] - across / depth * turn[2][1])
            by_z = rate * (row[2] - across / depth * turn[2][2])
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
