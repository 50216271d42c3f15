"""Project raw Gaussian parameters to packed splats; ``gradients`` computes the backward pass.

EWA splatting (Zwicker et al. 2001) as in 3DGS and gsplat. With W the camera rotation, R the
Gaussian's, s its scales and J the 2 x 3 Jacobian of the pinhole projection,

    U = J W R diag(s)          [2, 3], rows u0 and u1
    Σ = U Uᵀ + 0.3 I

The ellipse is stored as in ``splat_layout``: e = 1 / Σyy, k = Σxy / Σyy and a = Σyy / det Σ = 1 / s, where
s is the variance of x at fixed y. s is the minimum of |u0 - k u1|² + 0.3 (1 + k²) over all k, so with
w = u0 - k u1

    s = |w|² + 0.3 (1 + k²),      det Σ = s Σyy,      ds = 2 w · (du0 - k du1).

No step loses digits to cancellation. The determinant of the thinnest needle cannot round to zero or below.
The derivative has no large terms of opposite sign: k is at the minimum, so dk drops out. Geometry is computed
in float64, colours in float32.

Anti-aliasing (Mip-Splatting, Yu et al. 2024, eq. 9 with gsplat's constant) multiplies the opacity by
rho = sqrt(det(U Uᵀ) / det Σ), where det(U Uᵀ) = |w x u1|².
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numba import prange

from cleargs.splat import constants
from cleargs.splat.kernels import splat_layout as layout
from cleargs.splat.kernels.cpu.binning import count_tiles
from cleargs.splat.kernels.cpu.harmonics import sh_basis
from cleargs.splat.kernels.cpu.jit import inlined, kernel
from cleargs.types import AnyArray, ArrayF32

DILATION = constants.DILATION
NEAR = constants.NEAR
QUATERNION_EPSILON = constants.QUATERNION_EPSILON
LOG2_ALPHA_CUT = constants.LOG2_ALPHA_CUT
SH_OFFSET = np.float32(constants.SH_OFFSET)
HALF_LOG2E = 0.5 / math.log(2.0)
TWO_LN2 = 2.0 * math.log(2.0)
WIDEST = -TWO_LN2 * LOG2_ALPHA_CUT * 1.01
"""Square of the distance, in standard deviations, at which an opaque splat ends, and a margin."""
FLOAT32_MAX = float(np.finfo(np.float32).max)
BLOCK = 128
"""Gaussians per work item; fixed, so that nothing depends on the number of threads."""

ZERO = np.float32(0)

Parameters = tuple[ArrayF32, ...]
"""Means, log scales, rotations, logits of the opacities and SH of all Gaussians, or their gradients."""


Vector = tuple[float, float, float]


class ProjectionView(NamedTuple):
    """A camera as the kernels read it; see `cleargs.splat.kernels.rasteriser.view_numbers`."""

    w00: float
    w01: float
    w02: float
    w10: float
    w11: float
    w12: float
    w20: float
    w21: float
    w22: float
    tx: float
    ty: float
    tz: float
    centre_x: float
    centre_y: float
    centre_z: float
    fx: float
    fy: float
    cx: float
    cy: float
    left: float  # bounds of x/z and y/z in the Jacobian
    right: float
    top: float
    bottom: float


@inlined
def own_view(g: int, view: ProjectionView, poses: AnyArray) -> ProjectionView:
    """Return the view of Gaussian ``g``: by its row of ``poses`` [N, 12], or of [0, 12] the view itself."""
    if len(poses) == 0:
        return view
    p = poses[g]
    return ProjectionView(
        p[0], p[1], p[2], p[3], p[4], p[5], p[6], p[7], p[8], p[9], p[10], p[11],
        view.centre_x, view.centre_y, view.centre_z, view.fx, view.fy, view.cx, view.cy,
        view.left, view.right, view.top, view.bottom,
    )  # fmt: skip


@inlined
def dot(a: Vector, b: Vector) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@inlined
def cross(a: Vector, b: Vector) -> Vector:
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


@inlined
def mixed(a: float, u: Vector, b: float, v: Vector) -> Vector:
    """Return a u + b v."""
    return (a * u[0] + b * v[0], a * u[1] + b * v[1], a * u[2] + b * v[2])


@inlined
def residual(u0: Vector, u1: Vector, skew: float) -> Vector:
    """Return w = u0 - k u1, the variation of x at fixed y."""
    return (u0[0] - skew * u1[0], u0[1] - skew * u1[1], u0[2] - skew * u1[2])


@inlined
def is_finite(x: Any) -> bool:
    """Return True if a float64 is in the range of float32, in which it is stored; False for NaN."""
    finite: bool = abs(x) <= FLOAT32_MAX
    return finite


@inlined
def camera_position(mean: AnyArray, view: ProjectionView) -> Vector:
    """Return the Gaussian's centre in camera coordinates."""
    x, y, z = np.float64(mean[0]), np.float64(mean[1]), np.float64(mean[2])
    return (
        view.w00 * x + view.w01 * y + view.w02 * z + view.tx,
        view.w10 * x + view.w11 * y + view.w12 * z + view.ty,
        view.w20 * x + view.w21 * y + view.w22 * z + view.tz,
    )


@inlined
def direction_to(mean: AnyArray, view: ProjectionView) -> tuple[Vector, float]:
    """Return the unit vector in the world from the camera to the Gaussian's centre, and their distance."""
    x, y = np.float64(mean[0]) - view.centre_x, np.float64(mean[1]) - view.centre_y
    z = np.float64(mean[2]) - view.centre_z
    distance = math.sqrt(x * x + y * y + z * z)
    return (x / distance, y / distance, z / distance), distance


@inlined
def unit_quaternion(rotation: AnyArray) -> tuple[float, float, float, float, float]:
    """Return the normalised quaternion w x y z and the norm that it was divided by."""
    w, x = np.float64(rotation[0]), np.float64(rotation[1])
    y, z = np.float64(rotation[2]), np.float64(rotation[3])
    norm = max(math.sqrt(w * w + x * x + y * y + z * z), QUATERNION_EPSILON)
    return w / norm, x / norm, y / norm, z / norm, norm


@inlined
def scaled_axes(
    w: float, x: float, y: float, z: float, sx: float, sy: float, sz: float
) -> tuple[Vector, Vector, Vector]:
    """Return the columns of R diag(s): the Gaussian's axes in the world, one standard deviation long."""
    return (
        (sx * (1 - 2 * (y * y + z * z)), sx * 2 * (x * y + w * z), sx * 2 * (x * z - w * y)),
        (sy * 2 * (x * y - w * z), sy * (1 - 2 * (x * x + z * z)), sy * 2 * (y * z + w * x)),
        (sz * 2 * (x * z + w * y), sz * 2 * (y * z - w * x), sz * (1 - 2 * (x * x + y * y))),
    )


@inlined
def projection_rows(x: float, y: float, z: float, view: ProjectionView) -> tuple[Vector, Vector]:
    """Return the rows of J W. The clamps of x/z and y/z keep the linearisation near the image."""
    jx, jy = view.fx / z, view.fy / z
    jxz = -jx * min(max(x / z, view.left), view.right)
    jyz = -jy * min(max(y / z, view.top), view.bottom)
    return (
        (jx * view.w00 + jxz * view.w20, jx * view.w01 + jxz * view.w21, jx * view.w02 + jxz * view.w22),
        (jy * view.w10 + jyz * view.w20, jy * view.w11 + jyz * view.w21, jy * view.w12 + jyz * view.w22),
    )


@inlined
def outside(mean: float, size: int, row: Vector, largest: float) -> bool:
    """Return True if an opaque sphere with the ``largest`` scale would touch no pixel; False for NaN.

    The other numbers of a Gaussian, above all its SH, are not read then. In a room, half of them are outside
    the image.
    """
    extent = math.sqrt(WIDEST * (dot(row, row) * largest * largest + DILATION)) + 1.0
    return mean + extent < 0.0 or mean - extent > size + layout.TILE  # tiles may end beyond the image


@inlined
def project_one(
    g: int,
    parameters: Parameters,
    sh_count: int,
    view: ProjectionView,
    antialias: bool,
    size: tuple[int, int],  # width and height, px
    splats: ArrayF32,
    basis: ArrayF32,
) -> bool:
    """Write the packed splat of Gaussian ``g``.

    Return False if it is behind, outside the image, too faint or not finite.
    """
    means, log_scales, rotations, logits, sh = parameters
    x, y, z = camera_position(means[g], view)
    if not NEAR <= z <= FLOAT32_MAX:  # also if z is NaN
        return False
    row0, row1 = projection_rows(x, y, z, view)
    mean_x, mean_y = view.fx * x / z + view.cx, view.fy * y / z + view.cy
    largest = math.exp(max(log_scales[g, 0], log_scales[g, 1], log_scales[g, 2]))
    if outside(mean_x, size[0], row0, largest) or outside(mean_y, size[1], row1, largest):
        return False
    qw, qx, qy, qz, _ = unit_quaternion(rotations[g])
    sx, sy, sz = math.exp(log_scales[g, 0]), math.exp(log_scales[g, 1]), math.exp(log_scales[g, 2])
    axis0, axis1, axis2 = scaled_axes(qw, qx, qy, qz, sx, sy, sz)
    u0 = (dot(row0, axis0), dot(row0, axis1), dot(row0, axis2))
    u1 = (dot(row1, axis0), dot(row1, axis1), dot(row1, axis2))
    xx, xy, yy = dot(u0, u0) + DILATION, dot(u0, u1), dot(u1, u1) + DILATION
    skew = xy / yy
    w = residual(u0, u1, skew)
    variance = dot(w, w) + DILATION * (1.0 + skew * skew)
    log2_opacity = -math.log1p(math.exp(-np.float64(logits[g]))) / math.log(2.0)
    if antialias:
        normal = cross(w, u1)
        log2_opacity += 0.5 * math.log2(dot(normal, normal) / (variance * yy))
    reach = TWO_LN2 * (log2_opacity - LOG2_ALPHA_CUT)
    if not (reach >= 0.0 and is_finite(variance) and is_finite(xx) and is_finite(yy)):
        return False
    if not (is_finite(mean_x) and is_finite(mean_y)):
        return False

    direction, _ = direction_to(means[g], view)
    sh_basis(sh_count, np.float32(direction[0]), np.float32(direction[1]), np.float32(direction[2]), basis)
    red = green = blue = ZERO
    for k in range(sh_count):
        red += basis[k] * sh[g, k, 0]
        green += basis[k] * sh[g, k, 1]
        blue += basis[k] * sh[g, k, 2]
    if not (is_finite(red) and is_finite(green) and is_finite(blue)):
        return False

    splat = splats[g]
    splat[layout.MEAN_X] = mean_x
    splat[layout.MEAN_Y] = mean_y
    splat[layout.BEND_X] = HALF_LOG2E / variance
    splat[layout.SKEW] = skew
    splat[layout.BEND_Y] = HALF_LOG2E / yy
    splat[layout.LOG2_OPACITY] = log2_opacity
    splat[layout.RED] = max(red + SH_OFFSET, ZERO)
    splat[layout.GREEN] = max(green + SH_OFFSET, ZERO)
    splat[layout.BLUE] = max(blue + SH_OFFSET, ZERO)
    splat[layout.DEPTH] = z
    splat[layout.EXTENT_X] = math.sqrt(reach * xx)
    splat[layout.EXTENT_Y] = math.sqrt(reach * yy)
    splat[layout.EXTENT_X_AT] = xy * math.sqrt(reach / xx)
    return True


@kernel
def project(
    parameters: Parameters,
    sh_count: int,
    view: ProjectionView,
    poses: AnyArray,  # [N, 12] or [0, 12], see `own_view`
    antialias: bool,
    width: int,
    height: int,
    splats: ArrayF32,  # [N, 16], written
    tile_counts: AnyArray,  # [N], written
    radii: ArrayF32,  # [N] px, written
) -> None:
    """Write the packed splats, the number of tiles that each touches, and their radii.

    Culled Gaussians get no tile and radius 0; their rows of ``splats`` are not written.
    """
    n = splats.shape[0]
    for block in prange((n + BLOCK - 1) // BLOCK):
        basis = np.empty(16, np.float32)
        for g in range(block * BLOCK, min(n, (block + 1) * BLOCK)):
            tiles = 0
            own = own_view(g, view, poses)
            if project_one(g, parameters, sh_count, own, antialias, (width, height), splats, basis):
                tiles = count_tiles(splats[g], width, height)
                if len(poses) > 0:  # different poses would mix the order of Gaussians on one surface
                    splats[g, layout.DEPTH] = max(camera_position(parameters[0][g], view)[2], NEAR)
            tile_counts[g] = tiles
            radii[g] = max(splats[g, layout.EXTENT_X], splats[g, layout.EXTENT_Y]) if tiles > 0 else ZERO
