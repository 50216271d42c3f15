"""Real spherical harmonics (SH) up to degree 3 and their gradient with respect to the direction.

All functions work on one lane of rows in scratch memory. A loop that calls them for all lanes becomes vector
code.
"""

from __future__ import annotations

import numpy as np

from cleargs.splat import constants
from cleargs.splat.kernels.cpu.jit import unfused
from cleargs.types import ArrayF32

FUNCTIONS = 16
"""Basis functions up to degree 3."""
C0, C1 = np.float32(constants.SH_C0), np.float32(constants.SH_C1)
C20, C21, C22, C23, C24 = (np.float32(c) for c in constants.SH_C2)
C30, C31, C32, C33, C34, C35, C36 = (np.float32(c) for c in constants.SH_C3)
TWO, THREE, FOUR, SIX, EIGHT = (np.float32(n) for n in (2, 3, 4, 6, 8))


@unfused
def sh_basis(x: np.float32, y: np.float32, z: np.float32, basis: ArrayF32, lane: int) -> None:
    """Write the basis functions at the unit direction (x, y, z) into the rows of ``basis`` [16, lanes]."""
    xx, yy, zz = x * x, y * y, z * z
    basis[0, lane] = C0
    basis[1, lane] = -C1 * y
    basis[2, lane] = C1 * z
    basis[3, lane] = -C1 * x
    basis[4, lane] = C20 * x * y
    basis[5, lane] = C21 * y * z
    basis[6, lane] = C22 * (TWO * zz - xx - yy)
    basis[7, lane] = C23 * x * z
    basis[8, lane] = C24 * (xx - yy)
    basis[9, lane] = C30 * y * (THREE * xx - yy)
    basis[10, lane] = C31 * x * y * z
    basis[11, lane] = C32 * y * (FOUR * zz - xx - yy)
    basis[12, lane] = C33 * z * (TWO * zz - THREE * xx - THREE * yy)
    basis[13, lane] = C34 * x * (FOUR * zz - xx - yy)
    basis[14, lane] = C35 * z * (xx - yy)
    basis[15, lane] = C36 * x * (xx - THREE * yy)


@unfused
def sh_direction_gradient(
    x: np.float32, y: np.float32, z: np.float32, h: ArrayF32, lane: int
) -> tuple[np.float32, np.float32, np.float32]:
    """Return Σ_k h[k] ∂basis[k]/∂(x, y, z), with x, y and z as independent variables; h is [16, lanes]."""
    xx, yy, zz = x * x, y * y, z * z
    gx = C20 * y * h[4, lane] - TWO * C22 * x * h[6, lane] + C23 * z * h[7, lane] - C1 * h[3, lane]
    gy = C20 * x * h[4, lane] + C21 * z * h[5, lane] - TWO * C22 * y * h[6, lane] - C1 * h[1, lane]
    gz = C21 * y * h[5, lane] + FOUR * C22 * z * h[6, lane] + C23 * x * h[7, lane] + C1 * h[2, lane]
    gx += TWO * C24 * x * h[8, lane]
    gy -= TWO * C24 * y * h[8, lane]
    gx += SIX * C30 * x * y * h[9, lane] + C31 * y * z * h[10, lane] - TWO * C32 * x * y * h[11, lane]
    gx += C34 * (FOUR * zz - THREE * xx - yy) * h[13, lane] - SIX * C33 * x * z * h[12, lane]
    gx += TWO * C35 * x * z * h[14, lane] + THREE * C36 * (xx - yy) * h[15, lane]
    gy += THREE * C30 * (xx - yy) * h[9, lane] + C31 * x * z * h[10, lane]
    gy += C32 * (FOUR * zz - xx - THREE * yy) * h[11, lane] - SIX * C33 * y * z * h[12, lane]
    gy -= TWO * C34 * x * y * h[13, lane] + TWO * C35 * y * z * h[14, lane]
    gy -= SIX * C36 * x * y * h[15, lane]
    gz += C31 * x * y * h[10, lane] + EIGHT * C32 * y * z * h[11, lane] + EIGHT * C34 * x * z * h[13, lane]
    gz += THREE * C33 * (TWO * zz - xx - yy) * h[12, lane] + C35 * (xx - yy) * h[14, lane]
    return gx, gy, gz
