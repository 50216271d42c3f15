"""Real spherical harmonics (SH) up to degree 3 and their gradient with respect to the direction."""

from __future__ import annotations

import numpy as np

from cleargs.splat import constants
from cleargs.splat.kernels.cpu.jit import inlined
from cleargs.types import ArrayF32

C0, C1 = np.float32(constants.SH_C0), np.float32(constants.SH_C1)
C20, C21, C22, C23, C24 = (np.float32(c) for c in constants.SH_C2)
C30, C31, C32, C33, C34, C35, C36 = (np.float32(c) for c in constants.SH_C3)
TWO, THREE, FOUR, SIX, EIGHT = (np.float32(n) for n in (2, 3, 4, 6, 8))


@inlined
def sh_basis(count: int, x: np.float32, y: np.float32, z: np.float32, basis: ArrayF32) -> None:
    """Write the first ``count`` (1, 4, 9 or 16) basis functions at the unit direction (x, y, z)."""
    basis[0] = C0
    if count > 1:
        basis[1] = -C1 * y
        basis[2] = C1 * z
        basis[3] = -C1 * x
    xx, yy, zz = x * x, y * y, z * z
    if count > 4:
        basis[4] = C20 * x * y
        basis[5] = C21 * y * z
        basis[6] = C22 * (TWO * zz - xx - yy)
        basis[7] = C23 * x * z
        basis[8] = C24 * (xx - yy)
    if count > 9:
        basis[9] = C30 * y * (THREE * xx - yy)
        basis[10] = C31 * x * y * z
        basis[11] = C32 * y * (FOUR * zz - xx - yy)
        basis[12] = C33 * z * (TWO * zz - THREE * xx - THREE * yy)
        basis[13] = C34 * x * (FOUR * zz - xx - yy)
        basis[14] = C35 * z * (xx - yy)
        basis[15] = C36 * x * (xx - THREE * yy)


@inlined
def sh_direction_gradient(
    count: int, x: np.float32, y: np.float32, z: np.float32, h: ArrayF32
) -> tuple[np.float32, np.float32, np.float32]:
    """Return Σ_k h[k] ∂basis[k]/∂(x, y, z), with x, y and z as independent variables."""
    gx = gy = gz = np.float32(0)
    if count > 1:
        gx = -C1 * h[3]
        gy = -C1 * h[1]
        gz = C1 * h[2]
    if count > 4:
        gx += C20 * y * h[4] - TWO * C22 * x * h[6] + C23 * z * h[7] + TWO * C24 * x * h[8]
        gy += C20 * x * h[4] + C21 * z * h[5] - TWO * C22 * y * h[6] - TWO * C24 * y * h[8]
        gz += C21 * y * h[5] + FOUR * C22 * z * h[6] + C23 * x * h[7]
    if count > 9:
        xx, yy, zz = x * x, y * y, z * z
        gx += SIX * C30 * x * y * h[9] + C31 * y * z * h[10] - TWO * C32 * x * y * h[11]
        gx += C34 * (FOUR * zz - THREE * xx - yy) * h[13] - SIX * C33 * x * z * h[12]
        gx += TWO * C35 * x * z * h[14] + THREE * C36 * (xx - yy) * h[15]
        gy += THREE * C30 * (xx - yy) * h[9] + C31 * x * z * h[10]
        gy += C32 * (FOUR * zz - xx - THREE * yy) * h[11] - SIX * C33 * y * z * h[12]
        gy -= TWO * C34 * x * y * h[13] + TWO * C35 * y * z * h[14] + SIX * C36 * x * y * h[15]
        gz += C31 * x * y * h[10] + EIGHT * C32 * y * z * h[11] + EIGHT * C34 * x * z * h[13]
        gz += THREE * C33 * (TWO * zz - xx - yy) * h[12] + C35 * (xx - yy) * h[14]
    return gx, gy, gz
