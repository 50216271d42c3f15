"""Real spherical harmonics up to degree 3 and their derivatives by the direction, in float32.

All sixteen are computed. The compiler drops those that a smaller ``SH_COUNT`` does not read.
"""

from __future__ import annotations

import triton
import triton.language as tl

from cleargs.splat import constants


@triton.jit
def sh_basis(x, y, z):
    """Return the 16 basis functions at the unit direction (x, y, z)."""
    xx, yy, zz = x * x, y * y, z * z
    return (
        tl.zeros_like(x) + constants.SH_C0,
        -constants.SH_C1 * y,
        constants.SH_C1 * z,
        -constants.SH_C1 * x,
        constants.SH_C2[0] * x * y,
        constants.SH_C2[1] * y * z,
        constants.SH_C2[2] * (2.0 * zz - xx - yy),
        constants.SH_C2[3] * x * z,
        constants.SH_C2[4] * (xx - yy),
        constants.SH_C3[0] * y * (3.0 * xx - yy),
        constants.SH_C3[1] * x * y * z,
        constants.SH_C3[2] * y * (4.0 * zz - xx - yy),
        constants.SH_C3[3] * z * (2.0 * zz - 3.0 * xx - 3.0 * yy),
        constants.SH_C3[4] * x * (4.0 * zz - xx - yy),
        constants.SH_C3[5] * z * (xx - yy),
        constants.SH_C3[6] * x * (xx - 3.0 * yy),
    )


@triton.jit
def sh_by_x(x, y, z):
    """Return the derivatives of the 16 basis functions by x. The direction is three independent numbers."""
    xx, yy, zz = x * x, y * y, z * z
    zero = tl.zeros_like(x)
    return (
        zero,
        zero,
        zero,
        zero - constants.SH_C1,
        constants.SH_C2[0] * y,
        zero,
        -2.0 * constants.SH_C2[2] * x,
        constants.SH_C2[3] * z,
        2.0 * constants.SH_C2[4] * x,
        6.0 * constants.SH_C3[0] * x * y,
        constants.SH_C3[1] * y * z,
        -2.0 * constants.SH_C3[2] * x * y,
        -6.0 * constants.SH_C3[3] * x * z,
        constants.SH_C3[4] * (4.0 * zz - 3.0 * xx - yy),
        2.0 * constants.SH_C3[5] * x * z,
        3.0 * constants.SH_C3[6] * (xx - yy),
    )


@triton.jit
def sh_by_y(x, y, z):
    """Return the derivatives of the 16 basis functions by y."""
    xx, yy, zz = x * x, y * y, z * z
    zero = tl.zeros_like(x)
    return (
        zero,
        zero - constants.SH_C1,
        zero,
        zero,
        constants.SH_C2[0] * x,
        constants.SH_C2[1] * z,
        -2.0 * constants.SH_C2[2] * y,
        zero,
        -2.0 * constants.SH_C2[4] * y,
        3.0 * constants.SH_C3[0] * (xx - yy),
        constants.SH_C3[1] * x * z,
        constants.SH_C3[2] * (4.0 * zz - xx - 3.0 * yy),
        -6.0 * constants.SH_C3[3] * y * z,
        -2.0 * constants.SH_C3[4] * x * y,
        -2.0 * constants.SH_C3[5] * y * z,
        -6.0 * constants.SH_C3[6] * x * y,
    )


@triton.jit
def sh_by_z(x, y, z):
    """Return the derivatives of the 16 basis functions by z."""
    xx, yy, zz = x * x, y * y, z * z
    zero = tl.zeros_like(x)
    return (
        zero,
        zero,
        zero + constants.SH_C1,
        zero,
        zero,
        constants.SH_C2[1] * y,
        4.0 * constants.SH_C2[2] * z,
        constants.SH_C2[3] * x,
        zero,
        zero,
        constants.SH_C3[1] * x * y,
        8.0 * constants.SH_C3[2] * y * z,
        3.0 * constants.SH_C3[3] * (2.0 * zz - xx - yy),
        8.0 * constants.SH_C3[4] * x * z,
        constants.SH_C3[5] * (xx - yy),
        zero,
    )
