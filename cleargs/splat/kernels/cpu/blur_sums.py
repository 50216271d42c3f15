"""Sums for a least-squares fit of a frame image by the derivatives of a render.

For a small blur whose covariance is S, a frame image is

    offset + gain * render + shift . grad(render) + tr(S H(render)) / 2

where H is the Hessian of the render. It is linear in seven numbers.
"""

from __future__ import annotations

import numpy as np
from numba import prange

from cleargs.splat.kernels.cpu.jit import kernel
from cleargs.types import AnyArray, ArrayF32

TERMS = 8
"""The regressors 1, R, R_x, R_y, R_xx / 2, R_xy, R_yy / 2, and the frame image."""

_DARK = np.float32(0.02)  # linear light below which the noise no longer decreases with the light
_HALF = np.float32(0.5)
_QUARTER = np.float32(0.25)


@kernel
def blur_sums(
    render: ArrayF32,  # [H, W] linear light, smoothed
    observed: ArrayF32,  # [H, W] likewise
    weight: ArrayF32,  # [H, W] 0 where a pixel does not count
    stride: int,  # distance of the rows and columns that are read, px
    tile: int,  # side of the tiles, px
    sums: AnyArray,  # [R, 2, TERMS, TERMS] float64, written: lower triangles for the R rows that are read
) -> None:
    """Write the products of the regressors, summed per row over the tiles of each colour of a checkerboard.

    The weight of a pixel is divided by its squared light: after the sRGB curve, the noise of a frame image is
    about proportional to its light.
    """
    _, width = render.shape
    for k in prange(len(sums)):
        y = 1 + k * stride
        sums[k] = 0.0
        terms = np.empty(TERMS)
        for x in range(1, width - 1, stride):
            counted = weight[y, x]
            if counted == np.float32(0):
                continue
            middle = render[y, x]
            left, right, up, down = render[y, x - 1], render[y, x + 1], render[y - 1, x], render[y + 1, x]
            across = render[y + 1, x + 1] - render[y + 1, x - 1] - render[y - 1, x + 1] + render[y - 1, x - 1]
            terms[0] = 1.0
            terms[1] = middle
            terms[2] = _HALF * (right - left)
            terms[3] = _HALF * (down - up)
            terms[4] = _HALF * (left + right - middle - middle)
            terms[5] = _QUARTER * across
            terms[6] = _HALF * (up + down - middle - middle)
            terms[7] = observed[y, x]
            scale = counted / max(observed[y, x], _DARK) ** 2
            colour = (y // tile + x // tile) % 2
            for n in range(TERMS):
                product = scale * terms[n]
                for m in range(n + 1):
                    sums[k, colour, n, m] += product * terms[m]
