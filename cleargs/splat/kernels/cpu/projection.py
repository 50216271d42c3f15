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

Geometry is arithmetic over rows of `GROUP` Gaussians, without branches, so LLVM makes vector code of it. A
first loop finds the Gaussians that can touch the image; only these are read and projected.

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
from cleargs.splat.kernels.cpu.harmonics import FUNCTIONS, sh_basis
from cleargs.splat.kernels.cpu.jit import kernel, unfused
from cleargs.splat.kernels.cpu.lane_math import GROUP, exp, log2
from cleargs.splat.kernels.cpu.simd import prefetch, prefetch_to_write
from cleargs.types import AnyArray, ArrayF32, ArrayF64

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
BLOCK = 1024
"""Gaussians per work item; fixed, so that nothing depends on the number of threads."""

POSE_ROWS = 12
"""Rows of the scratch memory that hold the pose of each lane."""
MEAN = POSE_ROWS
ROTATION, LOG_SCALES, LOGIT = MEAN + 3, MEAN + 7, MEAN + 10
"""First rows of the parameters of each lane; `read_gaussian` writes them."""
INPUT_ROWS = LOGIT + 1
_LARGEST, _SEEN = INPUT_ROWS, INPUT_ROWS + 1
_SPLAT = _SEEN + 1  # columns of a splat; those of its colour are not used
_REACH = _SPLAT + layout.SPLAT_COLUMNS
_ROWS = _REACH + 1

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


@unfused
def set_poses(view: ProjectionView, rows: ArrayF64) -> None:
    """Write the pose of ``view`` for all lanes into the first `POSE_ROWS` of ``rows``."""
    for row in range(POSE_ROWS):
        for lane in range(GROUP):
            rows[row, lane] = view[row]


@unfused
def read_poses(poses: AnyArray, g: int, lane: int, rows: ArrayF64) -> None:
    """Write the pose of Gaussian ``g`` for a lane; nothing if ``poses`` is [0, 12]."""
    if len(poses) > 0:
        for row in range(POSE_ROWS):
            rows[row, lane] = poses[g, row]


@unfused
def read_gaussian(g: int, lane: int, parameters: Parameters, poses: AnyArray, rows: ArrayF64) -> None:
    """Write pose and geometry of Gaussian ``g`` for a lane into the first `INPUT_ROWS` of ``rows``."""
    means, log_scales, rotations, logits, _ = parameters
    for axis in range(3):
        rows[MEAN + axis, lane] = means[g, axis]
        rows[LOG_SCALES + axis, lane] = log_scales[g, axis]
    for part in range(4):
        rows[ROTATION + part, lane] = rotations[g, part]
    rows[LOGIT, lane] = logits[g]
    read_poses(poses, g, lane, rows)


@unfused
def lane_view(view: ProjectionView, rows: ArrayF64, lane: int) -> ProjectionView:
    """Return the view of a lane: ``view`` with the pose in ``rows``."""
    return ProjectionView(
        rows[0, lane], rows[1, lane], rows[2, lane], rows[3, lane], rows[4, lane], rows[5, lane],
        rows[6, lane], rows[7, lane], rows[8, lane], rows[9, lane], rows[10, lane], rows[11, lane],
        view.centre_x, view.centre_y, view.centre_z, view.fx, view.fy, view.cx, view.cy,
        view.left, view.right, view.top, view.bottom,
    )  # fmt: skip


@unfused
def dot(a: Vector, b: Vector) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@unfused
def cross(a: Vector, b: Vector) -> Vector:
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


@unfused
def mixed(a: float, u: Vector, b: float, v: Vector) -> Vector:
    """Return a u + b v."""
    return (a * u[0] + b * v[0], a * u[1] + b * v[1], a * u[2] + b * v[2])


@unfused
def residual(u0: Vector, u1: Vector, skew: float) -> Vector:
    """Return w = u0 - k u1, the variation of x at fixed y."""
    return (u0[0] - skew * u1[0], u0[1] - skew * u1[1], u0[2] - skew * u1[2])


@unfused
def is_finite(x: Any) -> bool:
    """Return True if a float64 is in the range of float32, in which it is stored; False for NaN."""
    finite: bool = abs(x) <= FLOAT32_MAX
    return finite


@unfused
def camera_position(x: float, y: float, z: float, view: ProjectionView) -> Vector:
    """Return a point of the world, float64, in camera coordinates."""
    return (
        view.w00 * x + view.w01 * y + view.w02 * z + view.tx,
        view.w10 * x + view.w11 * y + view.w12 * z + view.ty,
        view.w20 * x + view.w21 * y + view.w22 * z + view.tz,
    )


@unfused
def direction_to(x: float, y: float, z: float, view: ProjectionView) -> tuple[Vector, float]:
    """Return the unit vector in the world from the camera to a point, and their distance."""
    x, y, z = x - view.centre_x, y - view.centre_y, z - view.centre_z
    distance = math.sqrt(x * x + y * y + z * z)
    return (x / distance, y / distance, z / distance), distance


@unfused
def unit_quaternion(w: float, x: float, y: float, z: float) -> tuple[float, float, float, float, float]:
    """Return the normalised quaternion w x y z and the norm that it was divided by."""
    norm = math.sqrt(w * w + x * x + y * y + z * z)
    norm = QUATERNION_EPSILON if norm < QUATERNION_EPSILON else norm
    return w / norm, x / norm, y / norm, z / norm, norm


@unfused
def lane_quaternion(rows: ArrayF64, first: int, lane: int) -> tuple[float, float, float, float, float]:
    """Return `unit_quaternion` of the four rows from ``first`` on."""
    return unit_quaternion(
        rows[first, lane], rows[first + 1, lane], rows[first + 2, lane], rows[first + 3, lane]
    )


@unfused
def scaled_axes(
    w: float, x: float, y: float, z: float, sx: float, sy: float, sz: float
) -> tuple[Vector, Vector, Vector]:
    """Return the columns of R diag(s): the Gaussian's axes in the world, one standard deviation long."""
    return (
        (sx * (1 - 2 * (y * y + z * z)), sx * 2 * (x * y + w * z), sx * 2 * (x * z - w * y)),
        (sy * 2 * (x * y - w * z), sy * (1 - 2 * (x * x + z * z)), sy * 2 * (y * z + w * x)),
        (sz * 2 * (x * z + w * y), sz * 2 * (y * z - w * x), sz * (1 - 2 * (x * x + y * y))),
    )


@unfused
def bounded(value: float, low: float, high: float) -> float:
    value = low if value < low else value
    return high if value > high else value


@unfused
def projection_rows(x: float, y: float, z: float, view: ProjectionView) -> tuple[Vector, Vector]:
    """Return the rows of J W. The clamps of x/z and y/z keep the linearisation near the image."""
    jx, jy = view.fx / z, view.fy / z
    jxz = -jx * bounded(x / z, view.left, view.right)
    jyz = -jy * bounded(y / z, view.top, view.bottom)
    return (
        (jx * view.w00 + jxz * view.w20, jx * view.w01 + jxz * view.w21, jx * view.w02 + jxz * view.w22),
        (jy * view.w10 + jyz * view.w20, jy * view.w11 + jyz * view.w21, jy * view.w12 + jyz * view.w22),
    )


@unfused
def outside(mean: float, size: int, row: Vector, largest: float) -> bool:
    """Return True if an opaque sphere with the ``largest`` scale would touch no pixel; False for NaN.

    The other numbers of a Gaussian, above all its SH, are not read then. In a room, half of them are outside
    the image.
    """
    extent = math.sqrt(WIDEST * (dot(row, row) * largest * largest + DILATION)) + 1.0
    # Tiles may end beyond the image.
    return (mean + extent < 0.0) | (mean - extent > size + layout.TILE)


@unfused
def list_candidates(
    first: int,
    last: int,
    parameters: Parameters,
    view: ProjectionView,
    poses: AnyArray,
    size: tuple[int, int],
    rows: ArrayF64,
    found: AnyArray,
    count: int,
) -> int:
    """Append to ``found`` those of the next `GROUP` Gaussians that may touch the image.

    The next ones are ``first`` to at most ``last``. Left out is what is behind the camera or outside the
    image. Returns the new ``count`` of those that were found.
    """
    means, log_scales = parameters[0], parameters[1]
    for lane in range(GROUP):
        g = min(first + lane, last)
        rows[MEAN, lane], rows[MEAN + 1, lane], rows[MEAN + 2, lane] = means[g, 0], means[g, 1], means[g, 2]
        rows[_LARGEST, lane] = max(log_scales[g, 0], log_scales[g, 1], log_scales[g, 2])
        read_poses(poses, g, lane, rows)
    for lane in range(GROUP):
        own = lane_view(view, rows, lane)
        x, y, z = camera_position(rows[MEAN, lane], rows[MEAN + 1, lane], rows[MEAN + 2, lane], own)
        row0, row1 = projection_rows(x, y, z, own)
        largest = exp(rows[_LARGEST, lane])
        seen = (z >= NEAR) & (z <= FLOAT32_MAX)  # not if z is NaN
        seen &= not outside(view.fx * x / z + view.cx, size[0], row0, largest)
        seen &= not outside(view.fy * y / z + view.cy, size[1], row1, largest)
        rows[_SEEN, lane] = 1.0 if seen else 0.0
    for lane in range(min(GROUP, last + 1 - first)):
        found[count] = first + lane
        count += rows[_SEEN, lane] > 0.0
    return count


@unfused
def project_lanes(
    found: AnyArray,
    first: int,
    last: int,
    parameters: Parameters,
    view: ProjectionView,
    poses: AnyArray,
    antialias: bool,
    rows: ArrayF64,
    basis: ArrayF32,
    sh_count: int,
    splats: ArrayF32,
) -> None:
    """Write splats without colour and their reach into ``rows``, and their SH basis into ``basis``.

    They are the next `GROUP` of ``found``, from ``first`` to at most ``last``. The reach is negative, or NaN,
    for a splat that is too faint or not finite. SH and ``splats`` are only prefetched.
    """
    sh = parameters[4]
    for lane in range(GROUP):
        g = found[min(first + lane, last)]
        read_gaussian(g, lane, parameters, poses, rows)
        for line in range(0, 3 * sh_count, 16):
            prefetch(sh, g * sh.shape[1] * 3 + line)
        prefetch_to_write(splats, g * layout.SPLAT_COLUMNS)
    for lane in range(GROUP):
        own = lane_view(view, rows, lane)
        x, y, z = camera_position(rows[MEAN, lane], rows[MEAN + 1, lane], rows[MEAN + 2, lane], own)
        row0, row1 = projection_rows(x, y, z, own)
        mean_x, mean_y = view.fx * x / z + view.cx, view.fy * y / z + view.cy
        qw, qx, qy, qz, _ = lane_quaternion(rows, ROTATION, lane)
        sx, sy = exp(rows[LOG_SCALES, lane]), exp(rows[LOG_SCALES + 1, lane])
        axis0, axis1, axis2 = scaled_axes(qw, qx, qy, qz, sx, sy, exp(rows[LOG_SCALES + 2, lane]))
        u0 = (dot(row0, axis0), dot(row0, axis1), dot(row0, axis2))
        u1 = (dot(row1, axis0), dot(row1, axis1), dot(row1, axis2))
        xx, xy, yy = dot(u0, u0) + DILATION, dot(u0, u1), dot(u1, u1) + DILATION
        skew = xy / yy
        w = residual(u0, u1, skew)
        variance = dot(w, w) + DILATION * (1.0 + skew * skew)
        log2_opacity = -log2(1.0 + exp(-rows[LOGIT, lane]))
        if antialias:
            normal = cross(w, u1)
            log2_opacity += 0.5 * log2(dot(normal, normal) / (variance * yy))
        reach = TWO_LN2 * (log2_opacity - LOG2_ALPHA_CUT)
        finite = is_finite(variance) & is_finite(xx) & is_finite(yy) & is_finite(mean_x) & is_finite(mean_y)
        rows[_REACH, lane] = reach if finite else -1.0
        rows[_SPLAT + layout.MEAN_X, lane] = mean_x
        rows[_SPLAT + layout.MEAN_Y, lane] = mean_y
        rows[_SPLAT + layout.BEND_X, lane] = HALF_LOG2E / variance
        rows[_SPLAT + layout.SKEW, lane] = skew
        rows[_SPLAT + layout.BEND_Y, lane] = HALF_LOG2E / yy
        rows[_SPLAT + layout.LOG2_OPACITY, lane] = log2_opacity
        rows[_SPLAT + layout.DEPTH, lane] = z
        rows[_SPLAT + layout.EXTENT_X, lane] = math.sqrt(reach * xx)
        rows[_SPLAT + layout.EXTENT_Y, lane] = math.sqrt(reach * yy)
        rows[_SPLAT + layout.EXTENT_X_AT, lane] = xy * math.sqrt(reach / xx)
        direction, _ = direction_to(rows[MEAN, lane], rows[MEAN + 1, lane], rows[MEAN + 2, lane], view)
        sh_basis(np.float32(direction[0]), np.float32(direction[1]), np.float32(direction[2]), basis, lane)


@unfused
def write_splat(
    g: int, lane: int, sh: ArrayF32, sh_count: int, rows: ArrayF64, basis: ArrayF32, splat: ArrayF32
) -> bool:
    """Write the splat of a lane with its colour; return False if it is too faint or not finite."""
    if not rows[_REACH, lane] >= 0.0:  # also if it is NaN
        return False
    red = green = blue = ZERO
    for k in range(sh_count):
        red += basis[k, lane] * sh[g, k, 0]
        green += basis[k, lane] * sh[g, k, 1]
        blue += basis[k, lane] * sh[g, k, 2]
    if not (is_finite(red) and is_finite(green) and is_finite(blue)):
        return False
    for column in range(layout.EXTENT_X_AT + 1):
        splat[column] = rows[_SPLAT + column, lane]
    splat[layout.RED] = max(red + SH_OFFSET, ZERO)
    splat[layout.GREEN] = max(green + SH_OFFSET, ZERO)
    splat[layout.BLUE] = max(blue + SH_OFFSET, ZERO)
    return True


@kernel
def project(
    parameters: Parameters,
    sh_count: int,
    view: ProjectionView,
    poses: AnyArray,  # [N, 12] float64, the pose of each Gaussian's row; [0, 12]: that of the view
    antialias: bool,
    width: int,
    height: int,
    splats: ArrayF32,  # [N, 16], written
    tile_counts: AnyArray,  # [N], written
    radii: ArrayF32,  # [N] px, written
) -> None:
    """Write the packed splats, the number of tiles that each touches, and their radii.

    Culled Gaussians get no tile and radius 0; their rows of ``splats`` are not written. They are behind the
    camera, outside the image or too faint, or their splat is not finite.
    """
    n = splats.shape[0]
    for block in prange((n + BLOCK - 1) // BLOCK):
        begin, end = block * BLOCK, min(n, (block + 1) * BLOCK)
        rows, found = np.empty((_ROWS, GROUP)), np.empty(BLOCK, np.int64)
        basis = np.empty((FUNCTIONS, GROUP), np.float32)
        set_poses(view, rows)
        count = 0
        for first in range(begin, end, GROUP):
            count = list_candidates(
                first, end - 1, parameters, view, poses, (width, height), rows, found, count
            )
        for g in range(begin, end):
            tile_counts[g] = 0
            radii[g] = ZERO
        for first in range(0, count, GROUP):
            project_lanes(
                found, first, count - 1, parameters, view, poses, antialias, rows, basis, sh_count, splats
            )
            for lane in range(min(GROUP, count - first)):
                g = found[first + lane]
                if write_splat(g, lane, parameters[4], sh_count, rows, basis, splats[g]):
                    tiles = count_tiles(splats[g], width, height)
                    tile_counts[g] = tiles
                    if tiles > 0:
                        radii[g] = max(splats[g, layout.EXTENT_X], splats[g, layout.EXTENT_Y])
                    if len(poses) > 0:  # different poses would mix the order of Gaussians on one surface
                        mean = parameters[0][g]
                        x, y, z = np.float64(mean[0]), np.float64(mean[1]), np.float64(mean[2])
                        splats[g, layout.DEPTH] = max(camera_position(x, y, z, view)[2], NEAR)
