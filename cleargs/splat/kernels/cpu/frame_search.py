"""Kernels of the search for a frame's motion: its residual (sum of differences), and a Gauss-Newton step.

Images have one channel and no margin. ``frame_warp`` has the formula of the fields.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import prange

from cleargs.splat.kernels.cpu.frame_warp import between, deviation, second_order, third_order
from cleargs.splat.kernels.cpu.jit import inlined, kernel
from cleargs.types import AnyArray, ArrayF32

_ONE = np.float32(1)


@inlined
def _mixed(plane: Any, i: Any, j: Any, a: Any, b: Any) -> Any:
    """Interpolate ``plane`` [H, W] linearly between four pixels, of which column i, row j is the top left."""
    above = plane[j, i] + a * (plane[j, i + 1] - plane[j, i])
    below = plane[j + 1, i] + a * (plane[j + 1, i + 1] - plane[j + 1, i])
    return above + b * (below - above)


@kernel
def flows(
    basis: ArrayF32,  # [6, 2, H, W]: image motion per component of a twist, px
    twists: ArrayF32,  # [T, 6]
    asked: AnyArray,  # [H] bool: rows that are needed; the others are 0
    out: ArrayF32,  # [T, 2, H, W], written
) -> None:
    """Write the image motion of each twist, px."""
    _, _, height, width = basis.shape
    for y in prange(height):
        for axis in range(2):
            for t in range(len(twists)):  # a row of the basis stays in the cache
                if asked[y]:
                    for x in range(width):
                        total = np.float32(0)
                        for n in range(6):
                            total += twists[t, n] * basis[n, axis, y, x]
                        out[t, axis, y, x] = total
                else:
                    for x in range(width):
                        out[t, axis, y, x] = np.float32(0)


@kernel
def residuals(
    image: ArrayF32,  # [H, W]
    observed: ArrayF32,  # [H, W]
    weight: ArrayF32,  # [H, W]
    offset: ArrayF32,  # [2, H, W]
    sweep: ArrayF32,  # [2, H, W]
    radius: ArrayF32,  # [H, W]
    curve: ArrayF32 | None,  # [4, H, W]
    samples: ArrayF32,  # [K, 3] t, u, v
    limit: float,
    rows: AnyArray,  # [H] float64, written
) -> None:
    """Write each row's sum of weight * min(|observed - warped image|, limit); images have no margin.

    Pixels with weight 0 are skipped.
    """
    height, width = image.shape
    right, bottom = np.float32(width - 1), np.float32(height - 1)
    share = _ONE / np.float32(len(samples))
    for y in prange(height):
        # Pixels that count are packed without gaps, so that the inner loop can be vectorised.
        place, along = np.empty((2, width), np.float32), np.empty((2, width), np.float32)
        wide, exposed = np.empty(width, np.float32), np.zeros(width, np.float32)
        bent = np.empty((4, 0 if curve is None else width), np.float32)
        count = 0
        for x in range(width):
            if weight[y, x] != 0.0:
                place[0, count] = np.float32(x) + offset[0, y, x]
                place[1, count] = np.float32(y) + offset[1, y, x]
                along[0, count], along[1, count] = sweep[0, y, x], sweep[1, y, x]
                wide[count] = radius[y, x]
                if curve is not None:
                    for part in range(4):
                        bent[part, count] = curve[part, y, x]
                count += 1
        for k in range(len(samples)):
            for n in range(count):
                at_x = place[0, n] + samples[k, 0] * along[0, n] + samples[k, 1] * wide[n]
                at_y = place[1, n] + samples[k, 0] * along[1, n] + samples[k, 2] * wide[n]
                if curve is not None:
                    at_x += deviation(samples[k, 0], bent[0, n], bent[2, n])
                    at_y += deviation(samples[k, 0], bent[1, n], bent[3, n])
                i, a = between(at_x, right)
                j, b = between(at_y, bottom)
                exposed[n] += _mixed(image, i, j, a, b)
        total, count = 0.0, 0
        for x in range(width):
            if weight[y, x] != 0.0:
                total += weight[y, x] * min(abs(observed[y, x] - exposed[count] * share), limit)
                count += 1
        rows[y] = total


@kernel
def normal_equations(
    image: ArrayF32,  # [H, W]
    smooth: ArrayF32,  # [H, W]: the smoothed image, whose slopes are used
    observed: ArrayF32,  # [H, W]
    weight: ArrayF32,  # [H, W]
    basis: ArrayF32,  # [6, 2, H, W]: image motion per component of a twist, px
    down: ArrayF32,  # [H]: -1/2 at the first row of the frame, 1/2 at its last
    offset: ArrayF32,  # [2, H, W]
    sweep: ArrayF32,  # [2, H, W]
    curve: ArrayF32 | None,  # [4, H, W]
    times: ArrayF32,  # [K]
    outlier: float,
    active: AnyArray,  # [A] int64: unknowns, as indices of the 30 numbers of pose, blur, skew, bend and cube
    matrices: AnyArray,  # [H, A, A] float64, written
    sides: AnyArray,  # [H, A] float64, written
) -> None:
    """Write each row's share of the Gauss-Newton equations for the twists of a frame's motion.

    Differences beyond ``outlier`` count linearly (Huber's weights). Without ``curve``, bend and cube are not
    among the unknowns.
    """
    height, width = observed.shape
    right, bottom = np.float32(width - 1), np.float32(height - 1)
    share = np.float32(1.0 / times.size)
    twist, unknowns = basis.shape[0], len(active)
    for y in prange(height):
        # Pixels that count are packed without gaps, so that the inner loops can be vectorised.
        columns = np.empty(width, np.int64)
        place, along = np.empty((2, width), np.float32), np.empty((2, width), np.float32)
        bent = np.empty((4, 0 if curve is None else width), np.float32)
        count = 0
        for x in range(width):
            if weight[y, x] != 0.0:
                columns[count] = x
                place[0, count] = np.float32(x) + offset[0, y, x]
                place[1, count] = np.float32(y) + offset[1, y, x]
                along[0, count], along[1, count] = sweep[0, y, x], sweep[1, y, x]
                if curve is not None:
                    for part in range(4):
                        bent[part, count] = curve[part, y, x]
                count += 1
        # The image, and its derivatives times each polynomial of time.
        sums = np.zeros((5 if curve is None else 9, count), np.float32)
        for t in times:
            second, third = second_order(t), third_order(t)
            for p in range(count):
                at_x = place[0, p] + t * along[0, p]
                at_y = place[1, p] + t * along[1, p]
                if curve is not None:
                    at_x += second * bent[0, p] + third * bent[2, p]
                    at_y += second * bent[1, p] + third * bent[3, p]
                i, a = between(at_x, right)
                j, b = between(at_y, bottom)
                sums[0, p] += _mixed(image, i, j, a, b)
                above = smooth[j, i + 1] - smooth[j, i]
                below = smooth[j + 1, i + 1] - smooth[j + 1, i]
                slope_x = above + b * (below - above)
                slope_y = smooth[j + 1, i] - smooth[j, i] + a * (below - above)
                sums[1, p] += slope_x
                sums[2, p] += slope_y
                sums[3, p] += t * slope_x
                sums[4, p] += t * slope_y
                if curve is not None:
                    sums[5, p] += second * slope_x
                    sums[6, p] += second * slope_y
                    sums[7, p] += third * slope_x
                    sums[8, p] += third * slope_y
        jacobian, asked = np.empty((3 if curve is None else 5) * twist), np.empty(unknowns)
        matrix, side = np.zeros((unknowns, unknowns)), np.zeros(unknowns)
        for p in range(count):
            x = columns[p]
            for n in range(twist):
                u, v = share * basis[n, 0, y, x], share * basis[n, 1, y, x]
                moved = u * sums[1, p] + v * sums[2, p]
                jacobian[n] = moved
                jacobian[twist + n] = u * sums[3, p] + v * sums[4, p]
                jacobian[2 * twist + n] = down[y] * moved
                if curve is not None:
                    jacobian[3 * twist + n] = u * sums[5, p] + v * sums[6, p]
                    jacobian[4 * twist + n] = u * sums[7, p] + v * sums[8, p]
            left = observed[y, x] - share * sums[0, p]
            factor = weight[y, x] / max(1.0, abs(left) / outlier)
            for n in range(unknowns):
                asked[n] = jacobian[active[n]]
            for n in range(unknowns):
                scaled = factor * asked[n]
                side[n] += scaled * left
                for m in range(unknowns):  # the whole row, which is faster than its part up to n
                    matrix[n, m] += scaled * asked[m]
        for n in range(unknowns):  # as loops, which compile in half the time of two assignments
            sides[y, n] = side[n]
            for m in range(unknowns):
                matrices[y, n, m] = matrix[n, m]
