"""Kernels on the ways that pixels take during an exposure.

During its exposure the pixel at x sees the still image at x + offset(x) + t * sweep(x), where t are the
``times``, evenly from -1/2 to 1/2; beyond the border the border pixels go on. Fields are [2, H, W] float32, x
before y, in pixels; images are at least two pixels high and wide.

A row's arithmetic does not depend on other rows, and what is scattered is summed in one order: results do not
depend on the number of threads.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import prange

from cleargs.splat.kernels.cpu.jit import Array, Floats, inlined, kernel, serial_kernel


@inlined
def _between(position: Any, last: Any) -> tuple[Any, Any]:  # float32 -> int32, float32
    """The first of the two pixels that ``position`` lies between, and the share of the second."""
    inside = min(max(position, np.float32(0)), last)
    first = np.int32(min(inside, last - np.float32(1)))
    return first, inside - np.float32(first)


@kernel
def misfits(
    image: Floats,  # [H, W]
    observed: Floats,  # [H, W]
    weight: Floats,  # [H, W]
    offset: Floats,
    sweep: Floats,
    times: Floats,  # [K]
    limit: float,
    rows: Array,  # [H] float64, written
) -> None:
    """Each row's sum of weight * min(|observed - exposed image|, limit)."""
    height, width = image.shape
    right, bottom = np.float32(width - 1), np.float32(height - 1)
    share = np.float32(1) / np.float32(times.size)
    for y in prange(height):
        exposed = np.zeros(width, np.float32)
        for t in times:  # pixels innermost: the loop that can be vectorised
            for x in range(width):
                i, a = _between(np.float32(x) + offset[0, y, x] + t * sweep[0, y, x], right)
                j, b = _between(np.float32(y) + offset[1, y, x] + t * sweep[1, y, x], bottom)
                above = image[j, i] + a * (image[j, i + 1] - image[j, i])
                below = image[j + 1, i] + a * (image[j + 1, i + 1] - image[j + 1, i])
                exposed[x] += above + b * (below - above)
        total = 0.0
        for x in range(width):
            total += weight[y, x] * min(abs(observed[y, x] - exposed[x] * share), limit)
        rows[y] = total


@kernel
def normal_equations(
    stack: Floats,  # [H, W, 3]: image, its derivatives by x and y
    observed: Floats,  # [H, W]
    weight: Floats,  # [H, W]
    basis: Floats,  # [6, 2, H, W]: flow by each component of a twist
    offset: Floats,
    sweep: Floats,
    times: Floats,  # [K]
    outlier: float,
    matrices: Array,  # [H, 12, 12] float64, written (lower triangles)
    sides: Array,  # [H, 12] float64, written
) -> None:
    """Each row's share of the Gauss-Newton equations of the blur's twist and the skew's.

    Differences beyond ``outlier`` count linearly (Huber's weights).
    """
    height, width = observed.shape
    right, bottom = np.float32(width - 1), np.float32(height - 1)
    share = 1.0 / times.size
    twist = basis.shape[0]
    for y in prange(height):
        matrices[y] = 0.0
        sides[y] = 0.0
        down = (y + 0.5) / height - 0.5
        jacobian = np.empty(2 * twist)
        means = np.empty(5, np.float32)
        for x in range(width):
            if weight[y, x] == 0.0:
                continue
            means[:] = 0.0
            for t in times:
                i, a = _between(np.float32(x) + offset[0, y, x] + t * sweep[0, y, x], right)
                j, b = _between(np.float32(y) + offset[1, y, x] + t * sweep[1, y, x], bottom)
                for c in range(3):
                    above = stack[j, i, c] + a * (stack[j, i + 1, c] - stack[j, i, c])
                    below = stack[j + 1, i, c] + a * (stack[j + 1, i + 1, c] - stack[j + 1, i, c])
                    value = above + b * (below - above)
                    means[c] += value
                    if c > 0:
                        means[c + 2] += t * value
            for n in range(twist):
                u, v = share * basis[n, 0, y, x], share * basis[n, 1, y, x]
                jacobian[n] = u * means[3] + v * means[4]
                jacobian[twist + n] = down * (u * means[1] + v * means[2])
            left = observed[y, x] - share * means[0]
            factor = weight[y, x] / max(1.0, abs(left) / outlier)
            for n in range(2 * twist):
                scaled = factor * jacobian[n]
                sides[y, n] += scaled * left
                for m in range(n + 1):
                    matrices[y, n, m] += scaled * jacobian[m]


@kernel
def expose(image: Floats, offset: Floats, sweep: Floats, times: Floats, out: Floats) -> None:
    """The exposed image; ``image`` and ``out`` are [H, W, 3]."""
    height, width, _ = image.shape
    right, bottom, one = np.float32(width - 1), np.float32(height - 1), np.float32(1)
    share = one / np.float32(times.size)
    for y in prange(height):
        for x in range(width):
            red, green, blue = np.float32(0), np.float32(0), np.float32(0)
            for t in times:
                i, a = _between(np.float32(x) + offset[0, y, x] + t * sweep[0, y, x], right)
                j, b = _between(np.float32(y) + offset[1, y, x] + t * sweep[1, y, x], bottom)
                p, q, r, s = (one - b) * (one - a), (one - b) * a, b * (one - a), b * a
                red += p * image[j, i, 0] + q * image[j, i + 1, 0]
                red += r * image[j + 1, i, 0] + s * image[j + 1, i + 1, 0]
                green += p * image[j, i, 1] + q * image[j, i + 1, 1]
                green += r * image[j + 1, i, 1] + s * image[j + 1, i + 1, 1]
                blue += p * image[j, i, 2] + q * image[j, i + 1, 2]
                blue += r * image[j + 1, i, 2] + s * image[j + 1, i + 1, 2]
            out[y, x, 0], out[y, x, 1], out[y, x, 2] = red * share, green * share, blue * share


@serial_kernel
def spread(exposed: Floats, offset: Floats, sweep: Floats, times: Floats, out: Floats) -> None:
    """The transpose of `expose`: what every pixel saw goes back to where its light came from."""
    height, width, _ = exposed.shape
    right, bottom, one = np.float32(width - 1), np.float32(height - 1), np.float32(1)
    share = one / np.float32(times.size)
    out[:] = 0.0
    for y in range(height):
        for x in range(width):
            red, green, blue = share * exposed[y, x, 0], share * exposed[y, x, 1], share * exposed[y, x, 2]
            for t in times:
                i, a = _between(np.float32(x) + offset[0, y, x] + t * sweep[0, y, x], right)
                j, b = _between(np.float32(y) + offset[1, y, x] + t * sweep[1, y, x], bottom)
                for corner in range(4):
                    part = (b if corner & 2 else one - b) * (a if corner & 1 else one - a)
                    row, column = j + (corner >> 1), i + (corner & 1)
                    out[row, column, 0] += part * red
                    out[row, column, 1] += part * green
                    out[row, column, 2] += part * blue
