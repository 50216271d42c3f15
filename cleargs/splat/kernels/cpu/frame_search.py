"""Kernels of the search for a frame's motion: the misfit of a motion, and the equations of a step towards it.

Images have one channel and no margin; ``frame_warp`` has the formula of the fields.
"""

from __future__ import annotations

import numpy as np
from numba import prange

from cleargs.splat.kernels.cpu.frame_warp import between, bow, ess
from cleargs.splat.kernels.cpu.jit import kernel
from cleargs.types import AnyArray, ArrayF32

_ONE = np.float32(1)


@kernel
def misfits(
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
                    at_x += bow(samples[k, 0]) * bent[0, n] + ess(samples[k, 0]) * bent[2, n]
                    at_y += bow(samples[k, 0]) * bent[1, n] + ess(samples[k, 0]) * bent[3, n]
                i, a = between(at_x, right)
                j, b = between(at_y, bottom)
                above = image[j, i] + a * (image[j, i + 1] - image[j, i])
                below = image[j + 1, i] + a * (image[j + 1, i + 1] - image[j + 1, i])
                exposed[n] += above + b * (below - above)
        total, count = 0.0, 0
        for x in range(width):
            if weight[y, x] != 0.0:
                total += weight[y, x] * min(abs(observed[y, x] - exposed[count] * share), limit)
                count += 1
        rows[y] = total


@kernel
def normal_equations(
    stack: ArrayF32,  # [H, W, 3]: image, its derivatives by x and y
    observed: ArrayF32,  # [H, W]
    weight: ArrayF32,  # [H, W]
    basis: ArrayF32,  # [6, 2, H, W]: image motion per component of a twist, px
    down: ArrayF32,  # [H]: -1/2 at the first row of the frame, 1/2 at its last
    offset: ArrayF32,  # [2, H, W]
    sweep: ArrayF32,  # [2, H, W]
    curve: ArrayF32 | None,  # [4, H, W]
    times: ArrayF32,  # [K]
    outlier: float,
    active: AnyArray,  # [A] int64: unknowns, of the 30 numbers of pose, blur, skew, bend and cube
    matrices: AnyArray,  # [H, A, A] float64, written (lower triangles)
    sides: AnyArray,  # [H, A] float64, written
) -> None:
    """Write each row's share of the Gauss-Newton equations for the twists of a frame's motion.

    Differences beyond ``outlier`` count linearly (Huber's weights). Without ``curve``, bend and cube are no
    unknowns.
    """
    height, width = observed.shape
    right, bottom = np.float32(width - 1), np.float32(height - 1)
    share = 1.0 / times.size
    twist = basis.shape[0]
    for y in prange(height):
        matrices[y] = 0.0
        sides[y] = 0.0
        jacobian = np.empty((3 if curve is None else 5) * twist)
        means = np.empty(5 if curve is None else 9, np.float32)
        for x in range(width):
            if weight[y, x] == 0.0:
                continue
            means[:] = 0.0
            for t in times:
                at_x = np.float32(x) + offset[0, y, x] + t * sweep[0, y, x]
                at_y = np.float32(y) + offset[1, y, x] + t * sweep[1, y, x]
                if curve is not None:
                    at_x += bow(t) * curve[0, y, x] + ess(t) * curve[2, y, x]
                    at_y += bow(t) * curve[1, y, x] + ess(t) * curve[3, y, x]
                i, a = between(at_x, right)
                j, b = between(at_y, bottom)
                for c in range(3):
                    above = stack[j, i, c] + a * (stack[j, i + 1, c] - stack[j, i, c])
                    below = stack[j + 1, i, c] + a * (stack[j + 1, i + 1, c] - stack[j + 1, i, c])
                    value = above + b * (below - above)
                    means[c] += value
                    if c > 0:
                        means[c + 2] += t * value
                        if curve is not None:
                            means[c + 4] += bow(t) * value
                            means[c + 6] += ess(t) * value
            for n in range(twist):
                u, v = share * basis[n, 0, y, x], share * basis[n, 1, y, x]
                moved = u * means[1] + v * means[2]
                jacobian[n] = moved
                jacobian[twist + n] = u * means[3] + v * means[4]
                jacobian[2 * twist + n] = down[y] * moved
                if curve is not None:
                    jacobian[3 * twist + n] = u * means[5] + v * means[6]
                    jacobian[4 * twist + n] = u * means[7] + v * means[8]
            left = observed[y, x] - share * means[0]
            factor = weight[y, x] / max(1.0, abs(left) / outlier)
            for n in range(len(active)):
                scaled = factor * jacobian[active[n]]
                sides[y, n] += scaled * left
                for m in range(n + 1):
                    matrices[y, n, m] += scaled * jacobian[active[m]]
