"""From raw Gaussian parameters to packed splats, and the analytic way back.

EWA splatting (Zwicker et al. 2001) as in 3DGS and gsplat. With W the camera rotation, R the
Gaussian's, s its scales and J the 2 x 3 Jacobian of the pinhole projection,

    U = J W R diag(s)          [2, 3], rows u0 and u1
    Σ = U Uᵀ + 0.3 I

The ellipse is wanted as in ``layout``: e = 1 / Σyy, k = Σxy / Σyy and a = Σyy / det Σ = 1 / s, where s is the
variance of x at fixed y. It is the least of |u0 - k u1|² + 0.3 (1 + k²) over all k, so with w = u0 - k u1

    s = |w|² + 0.3 (1 + k²),      det Σ = s Σyy,      ds = 2 w · (du0 - k du1).

Nothing here cancels: however thin a needle, the determinant cannot round to zero or below, and the
derivative (k is at the minimum, so dk drops out) has no large terms that annihilate. Geometry is
computed in float64, colours in float32.

Anti-aliasing (Mip-Splatting, Yu et al. 2024, eq. 9 with gsplat's constant) multiplies the opacity by
rho = sqrt(det(U Uᵀ) / det Σ), where det(U Uᵀ) = |w x u1|².
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numba import prange

from cleargs.splat import constants
from cleargs.splat.camera import Camera
from cleargs.splat.kernels.cpu.binning import count_tiles
from cleargs.splat.kernels.cpu.harmonics import sh_basis, sh_direction_gradient
from cleargs.splat.kernels.cpu.jit import Array, Floats, device, kernel
from cleargs.splat.kernels.cpu.layout import (
    BEND_X,
    BEND_Y,
    BLUE,
    DEPTH,
    EXTENT_X,
    EXTENT_X_AT,
    EXTENT_Y,
    GREEN,
    LOG2_OPACITY,
    MEAN_X,
    MEAN_Y,
    PAIR_COLUMNS,
    RED,
    SKEW,
    SUM_BLUE,
    SUM_DEPTH,
    SUM_GREEN,
    SUM_RED,
    SUM_V,
    SUM_VU,
    SUM_VUU,
    SUM_VUY,
    SUM_VY,
    SUM_VYY,
)

DILATION = constants.DILATION
NEAR = constants.NEAR
QUATERNION_EPSILON = constants.QUATERNION_EPSILON
LOG2_ALPHA_CUT = constants.LOG2_ALPHA_CUT
SH_OFFSET = np.float32(constants.SH_OFFSET)
HALF_LOG2E = 0.5 / math.log(2.0)
TWO_LN2 = 2.0 * math.log(2.0)
FLOAT32_MAX = float(np.finfo(np.float32).max)
BLOCK = 128
"""Gaussians per work item; fixed, so that nothing depends on the number of threads."""

ZERO = np.float32(0)
ONE = np.float32(1)


class View(NamedTuple):
    """A camera as the kernels read it: world-to-camera rotation rows, translation, intrinsics, bounds."""

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


def view_of(camera: Camera) -> View:
    """The kernel's view of a camera, with gsplat's bounds for the Jacobian."""
    pose = camera.world_to_camera
    beyond_x = constants.VIEW_CLAMP * 0.5 * camera.width / camera.fx
    beyond_y = constants.VIEW_CLAMP * 0.5 * camera.height / camera.fy
    return View._make(
        [
            *pose[:3, :3].ravel().tolist(),
            *pose[:3, 3].tolist(),
            *camera.centre.tolist(),
            *(float(camera.fx), float(camera.fy), float(camera.cx), float(camera.cy)),
            float(-camera.cx / camera.fx - beyond_x),
            float((camera.width - camera.cx) / camera.fx + beyond_x),
            float(-camera.cy / camera.fy - beyond_y),
            float((camera.height - camera.cy) / camera.fy + beyond_y),
        ]
    )


@device
def dot(a: tuple[float, float, float], b: tuple[float, float, float]) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@device
def cross(a: tuple[float, float, float], b: tuple[float, float, float]) -> tuple[float, float, float]:
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


@device
def residual(
    u0: tuple[float, float, float], u1: tuple[float, float, float], skew: float
) -> tuple[float, float, float]:
    """w = u0 - k u1: what is left of x's variation when y is known."""
    return (u0[0] - skew * u1[0], u0[1] - skew * u1[1], u0[2] - skew * u1[2])


@device
def is_finite(x: Any) -> bool:
    """Within the range of float32. A comparison, as reassociation may cancel the x - x of math.isfinite."""
    finite: bool = abs(x) <= FLOAT32_MAX
    return finite


@device
def camera_position(mean: Array, view: View) -> tuple[float, float, float]:
    """The Gaussian's centre in camera coordinates."""
    x, y, z = np.float64(mean[0]), np.float64(mean[1]), np.float64(mean[2])
    return (
        view.w00 * x + view.w01 * y + view.w02 * z + view.tx,
        view.w10 * x + view.w11 * y + view.w12 * z + view.ty,
        view.w20 * x + view.w21 * y + view.w22 * z + view.tz,
    )


@device
def unit_quaternion(rotation: Array) -> tuple[float, float, float, float, float]:
    """The normalised quaternion w x y z and the norm it was divided by."""
    w, x = np.float64(rotation[0]), np.float64(rotation[1])
    y, z = np.float64(rotation[2]), np.float64(rotation[3])
    norm = max(math.sqrt(w * w + x * x + y * y + z * z), QUATERNION_EPSILON)
    return w / norm, x / norm, y / norm, z / norm, norm


@device
def scaled_axes(
    w: float, x: float, y: float, z: float, sx: float, sy: float, sz: float
) -> tuple[tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]]:
    """The columns of R diag(s): the Gaussian's axes in the world, one standard deviation long."""
    return (
        (sx * (1 - 2 * (y * y + z * z)), sx * 2 * (x * y + w * z), sx * 2 * (x * z - w * y)),
        (sy * 2 * (x * y - w * z), sy * (1 - 2 * (x * x + z * z)), sy * 2 * (y * z + w * x)),
        (sz * 2 * (x * z + w * y), sz * 2 * (y * z - w * x), sz * (1 - 2 * (x * x + y * y))),
    )


@device
def projection_rows(
    x: float, y: float, z: float, view: View
) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    """The rows of J W. x/z and y/z are clamped, which keeps the linearisation near the image."""
    jx, jy = view.fx / z, view.fy / z
    jxz = -jx * min(max(x / z, view.left), view.right)
    jyz = -jy * min(max(y / z, view.top), view.bottom)
    return (
        (jx * view.w00 + jxz * view.w20, jx * view.w01 + jxz * view.w21, jx * view.w02 + jxz * view.w22),
        (jy * view.w10 + jyz * view.w20, jy * view.w11 + jyz * view.w21, jy * view.w12 + jyz * view.w22),
    )


@device
def project_one(
    g: int,
    means: Floats,
    log_scales: Floats,
    rotations: Floats,
    logits: Floats,
    sh: Floats,
    sh_count: int,
    view: View,
    antialias: bool,
    splats: Floats,
    basis: Floats,
) -> bool:
    """Write the packed splat of Gaussian ``g``; False when it is culled (behind, too faint, not finite)."""
    x, y, z = camera_position(means[g], view)
    if not z >= NEAR:  # also when z is NaN
        return False
    qw, qx, qy, qz, _ = unit_quaternion(rotations[g])
    sx, sy, sz = math.exp(log_scales[g, 0]), math.exp(log_scales[g, 1]), math.exp(log_scales[g, 2])
    axis0, axis1, axis2 = scaled_axes(qw, qx, qy, qz, sx, sy, sz)
    row0, row1 = projection_rows(x, y, z, view)
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
    mean_x, mean_y = view.fx * x / z + view.cx, view.fy * y / z + view.cy
    reach = TWO_LN2 * (log2_opacity - LOG2_ALPHA_CUT)
    if not (reach >= 0.0 and is_finite(variance) and is_finite(xx) and is_finite(yy)):
        return False
    if not (is_finite(mean_x) and is_finite(mean_y)):
        return False

    dx = np.float64(means[g, 0]) - view.centre_x
    dy = np.float64(means[g, 1]) - view.centre_y
    dz = np.float64(means[g, 2]) - view.centre_z
    distance = math.sqrt(dx * dx + dy * dy + dz * dz)
    sh_basis(sh_count, np.float32(dx / distance), np.float32(dy / distance), np.float32(dz / distance), basis)
    red = green = blue = ZERO
    for k in range(sh_count):
        red += basis[k] * sh[g, k, 0]
        green += basis[k] * sh[g, k, 1]
        blue += basis[k] * sh[g, k, 2]
    if not (is_finite(red) and is_finite(green) and is_finite(blue)):
        return False

    splat = splats[g]
    splat[MEAN_X] = mean_x
    splat[MEAN_Y] = mean_y
    splat[BEND_X] = HALF_LOG2E / variance
    splat[SKEW] = skew
    splat[BEND_Y] = HALF_LOG2E / yy
    splat[LOG2_OPACITY] = log2_opacity
    splat[RED] = max(red + SH_OFFSET, ZERO)
    splat[GREEN] = max(green + SH_OFFSET, ZERO)
    splat[BLUE] = max(blue + SH_OFFSET, ZERO)
    splat[DEPTH] = z
    splat[EXTENT_X] = math.sqrt(reach * xx)
    splat[EXTENT_Y] = math.sqrt(reach * yy)
    splat[EXTENT_X_AT] = xy * math.sqrt(reach / xx)
    return True


@kernel
def project(
    means: Floats,
    log_scales: Floats,
    rotations: Floats,
    logits: Floats,
    sh: Floats,
    sh_count: int,
    view: View,
    antialias: bool,
    width: int,
    height: int,
    splats: Floats,
    tile_counts: Array,
    radii: Floats,
) -> None:
    """Packed splats [N, 16], the number of tiles that each touches [N] and its radius in px [N].

    Culled Gaussians have no tile and radius 0; their rows of ``splats`` are left as they were.
    """
    n = means.shape[0]
    for block in prange((n + BLOCK - 1) // BLOCK):
        basis = np.empty(16, np.float32)
        for g in range(block * BLOCK, min(n, (block + 1) * BLOCK)):
            tiles = 0
            if project_one(
                g, means, log_scales, rotations, logits, sh, sh_count, view, antialias, splats, basis
            ):
                tiles = count_tiles(splats[g], width, height)
            tile_counts[g] = tiles
            radii[g] = max(splats[g, EXTENT_X], splats[g, EXTENT_Y]) if tiles > 0 else ZERO


@device
def quaternion_gradient(
    w: float,
    x: float,
    y: float,
    z: float,
    c0: tuple[float, float, float],
    c1: tuple[float, float, float],
    c2: tuple[float, float, float],
) -> tuple[float, float, float, float]:
    """dL/d(unit quaternion) from the gradients c0, c1, c2 of the rotation matrix's columns."""
    return (
        2 * (x * (c1[2] - c2[1]) + y * (c2[0] - c0[2]) + z * (c0[1] - c1[0])),
        2 * (w * (c1[2] - c2[1]) + y * (c0[1] + c1[0]) + z * (c0[2] + c2[0]) - 2 * x * (c1[1] + c2[2])),
        2 * (w * (c2[0] - c0[2]) + x * (c0[1] + c1[0]) + z * (c1[2] + c2[1]) - 2 * y * (c0[0] + c2[2])),
        2 * (w * (c0[1] - c1[0]) + x * (c0[2] + c2[0]) + y * (c1[2] + c2[1]) - 2 * z * (c0[0] + c1[1])),
    )


@device
def colour_gradient(
    g: int,
    sh: Floats,
    sh_count: int,
    splat: Floats,
    direction: tuple[float, float, float],
    sums: Array,
    grad_sh: Floats,
    basis: Floats,
    weights: Floats,
) -> tuple[float, float, float]:
    """Write dL/dSH of one Gaussian and return dL/d(direction). No gradient where the colour is clamped."""
    red = np.float32(sums[SUM_RED]) if splat[RED] > ZERO else ZERO
    green = np.float32(sums[SUM_GREEN]) if splat[GREEN] > ZERO else ZERO
    blue = np.float32(sums[SUM_BLUE]) if splat[BLUE] > ZERO else ZERO
    x, y, z = np.float32(direction[0]), np.float32(direction[1]), np.float32(direction[2])
    sh_basis(sh_count, x, y, z, basis)
    for k in range(sh_count):
        grad_sh[g, k, 0] = basis[k] * red
        grad_sh[g, k, 1] = basis[k] * green
        grad_sh[g, k, 2] = basis[k] * blue
        weights[k] = sh[g, k, 0] * red + sh[g, k, 1] * green + sh[g, k, 2] * blue
    for k in range(sh_count, sh.shape[1]):
        grad_sh[g, k, 0] = ZERO
        grad_sh[g, k, 1] = ZERO
        grad_sh[g, k, 2] = ZERO
    gx, gy, gz = sh_direction_gradient(sh_count, x, y, z, weights)
    return np.float64(gx), np.float64(gy), np.float64(gz)


@device
def backpropagate_one(
    g: int,
    means: Floats,
    log_scales: Floats,
    rotations: Floats,
    logits: Floats,
    sh: Floats,
    sh_count: int,
    view: View,
    antialias: bool,
    splats: Floats,
    sums: Array,
    grad_means: Floats,
    grad_log_scales: Floats,
    grad_rotations: Floats,
    grad_logits: Floats,
    grad_sh: Floats,
    basis: Floats,
    weights: Floats,
) -> None:
    """The chain rule of ``project_one`` from the pixel sums of one Gaussian (see layout.SUM_*)."""
    x, y, z = camera_position(means[g], view)
    qw, qx, qy, qz, norm = unit_quaternion(rotations[g])
    sx, sy, sz = math.exp(log_scales[g, 0]), math.exp(log_scales[g, 1]), math.exp(log_scales[g, 2])
    axis0, axis1, axis2 = scaled_axes(qw, qx, qy, qz, sx, sy, sz)
    row0, row1 = projection_rows(x, y, z, view)
    u0 = (dot(row0, axis0), dot(row0, axis1), dot(row0, axis2))
    u1 = (dot(row1, axis0), dot(row1, axis1), dot(row1, axis2))
    yy = dot(u1, u1) + DILATION
    e = 1.0 / yy
    k = dot(u0, u1) * e
    w = residual(u0, u1, k)
    a = 1.0 / (dot(w, w) + DILATION * (1.0 + k * k))

    # ln alpha = ln opacity - ½ a u² - ½ e dy²,  u = dx - k dy
    grad_mean_x = a * sums[SUM_VU]
    grad_mean_y = e * sums[SUM_VY] - k * grad_mean_x
    grad_logits[g] = sums[SUM_V] / (1.0 + math.exp(np.float64(logits[g])))
    # d(ln alpha)/dk = a u dy,   dk = e [u1 · du0 + (w - k u1) · du1]
    by_k = e * a * sums[SUM_VUY]
    # d(ln alpha)/ds = ½ a² u²,  ds = 2 w · (du0 - k du1)
    by_w = a * a * sums[SUM_VUU]
    # d(ln alpha)/de = -½ dy²,   de = -2 e² u1 · du1
    by_yy = e * e * sums[SUM_VYY]
    normal = (0.0, 0.0, 0.0)
    by_area = 0.0
    if antialias:
        # ln rho = ½ (ln |n|² - ln s - ln Σyy),  n = w x u1 = u0 x u1,
        # d ln |n|² = 2 [(u1 x n) · du0 + (n x u0) · du1] / |n|²
        by_w -= a * sums[SUM_V]
        by_yy -= e * sums[SUM_V]
        normal = cross(w, u1)
        by_area = sums[SUM_V] / dot(normal, normal)
    side0, side1 = cross(u1, normal), cross(normal, u0)
    v0 = (
        by_w * w[0] + by_k * u1[0] + by_area * side0[0],
        by_w * w[1] + by_k * u1[1] + by_area * side0[1],
        by_w * w[2] + by_k * u1[2] + by_area * side0[2],
    )
    v1 = (
        (by_k - k * by_w) * w[0] + (by_yy - k * by_k) * u1[0] + by_area * side1[0],
        (by_k - k * by_w) * w[1] + (by_yy - k * by_k) * u1[1] + by_area * side1[1],
        (by_k - k * by_w) * w[2] + (by_yy - k * by_k) * u1[2] + by_area * side1[2],
    )
    # u0[i] = row0 · axis_i, axis_i = s_i R[:, i]
    m0 = (
        v0[0] * row0[0] + v1[0] * row1[0],
        v0[0] * row0[1] + v1[0] * row1[1],
        v0[0] * row0[2] + v1[0] * row1[2],
    )
    m1 = (
        v0[1] * row0[0] + v1[1] * row1[0],
        v0[1] * row0[1] + v1[1] * row1[1],
        v0[1] * row0[2] + v1[1] * row1[2],
    )
    m2 = (
        v0[2] * row0[0] + v1[2] * row1[0],
        v0[2] * row0[1] + v1[2] * row1[1],
        v0[2] * row0[2] + v1[2] * row1[2],
    )
    grad_log_scales[g, 0] = dot(m0, axis0)
    grad_log_scales[g, 1] = dot(m1, axis1)
    grad_log_scales[g, 2] = dot(m2, axis2)

    gw, gx, gy, gz = quaternion_gradient(
        qw,
        qx,
        qy,
        qz,
        (sx * m0[0], sx * m0[1], sx * m0[2]),
        (sy * m1[0], sy * m1[1], sy * m1[2]),
        (sz * m2[0], sz * m2[1], sz * m2[2]),
    )
    # Normalisation removes the component along the quaternion, unless the norm was bounded from below.
    along = gw * qw + gx * qx + gy * qy + gz * qz if norm > QUATERNION_EPSILON else 0.0
    grad_rotations[g, 0] = (gw - along * qw) / norm
    grad_rotations[g, 1] = (gx - along * qx) / norm
    grad_rotations[g, 2] = (gy - along * qy) / norm
    grad_rotations[g, 3] = (gz - along * qz) / norm

    # row0 = jx W0 + jxz W2 with jx = fx/z, jxz = -fx cx/z, cx = clamp(x/z); row1 alike
    r0 = (
        v0[0] * axis0[0] + v0[1] * axis1[0] + v0[2] * axis2[0],
        v0[0] * axis0[1] + v0[1] * axis1[1] + v0[2] * axis2[1],
        v0[0] * axis0[2] + v0[1] * axis1[2] + v0[2] * axis2[2],
    )
    r1 = (
        v1[0] * axis0[0] + v1[1] * axis1[0] + v1[2] * axis2[0],
        v1[0] * axis0[1] + v1[1] * axis1[1] + v1[2] * axis2[1],
        v1[0] * axis0[2] + v1[1] * axis1[2] + v1[2] * axis2[2],
    )
    grad_jx = r0[0] * view.w00 + r0[1] * view.w01 + r0[2] * view.w02
    grad_jxz = r0[0] * view.w20 + r0[1] * view.w21 + r0[2] * view.w22
    grad_jy = r1[0] * view.w10 + r1[1] * view.w11 + r1[2] * view.w12
    grad_jyz = r1[0] * view.w20 + r1[1] * view.w21 + r1[2] * view.w22
    jx, jy, tangent_x, tangent_y = view.fx / z, view.fy / z, x / z, y / z
    bounded_x = min(max(tangent_x, view.left), view.right)
    bounded_y = min(max(tangent_y, view.top), view.bottom)
    grad_tangent_x = grad_mean_x * view.fx - (grad_jxz * jx if bounded_x == tangent_x else 0.0)
    grad_tangent_y = grad_mean_y * view.fy - (grad_jyz * jy if bounded_y == tangent_y else 0.0)
    grad_z = (
        sums[SUM_DEPTH]
        - (grad_tangent_x * tangent_x + grad_tangent_y * tangent_y) / z
        - (grad_jx - grad_jxz * bounded_x) * jx / z
        - (grad_jy - grad_jyz * bounded_y) * jy / z
    )
    camera_gradient = (grad_tangent_x / z, grad_tangent_y / z, grad_z)

    dx = np.float64(means[g, 0]) - view.centre_x
    dy = np.float64(means[g, 1]) - view.centre_y
    dz = np.float64(means[g, 2]) - view.centre_z
    distance = math.sqrt(dx * dx + dy * dy + dz * dz)
    direction = (dx / distance, dy / distance, dz / distance)
    towards = colour_gradient(g, sh, sh_count, splats[g], direction, sums, grad_sh, basis, weights)
    radial = dot(towards, direction)
    grad_means[g, 0] = (
        dot((view.w00, view.w10, view.w20), camera_gradient) + (towards[0] - radial * direction[0]) / distance
    )
    grad_means[g, 1] = (
        dot((view.w01, view.w11, view.w21), camera_gradient) + (towards[1] - radial * direction[1]) / distance
    )
    grad_means[g, 2] = (
        dot((view.w02, view.w12, view.w22), camera_gradient) + (towards[2] - radial * direction[2]) / distance
    )


@device
def clear_gradients(
    g: int,
    grad_means: Floats,
    grad_log_scales: Floats,
    grad_rotations: Floats,
    grad_logits: Floats,
    grad_sh: Floats,
) -> None:
    """Zero gradient for a Gaussian that touches no tile."""
    grad_means[g, :] = ZERO
    grad_log_scales[g, :] = ZERO
    grad_rotations[g, :] = ZERO
    grad_logits[g] = ZERO
    for k in range(grad_sh.shape[1]):
        grad_sh[g, k, 0] = ZERO
        grad_sh[g, k, 1] = ZERO
        grad_sh[g, k, 2] = ZERO


@kernel
def backpropagate(
    means: Floats,
    log_scales: Floats,
    rotations: Floats,
    logits: Floats,
    sh: Floats,
    sh_count: int,
    view: View,
    antialias: bool,
    splats: Floats,
    pair_offsets: Array,
    pair_sums: Floats,
    grad_means: Floats,
    grad_log_scales: Floats,
    grad_rotations: Floats,
    grad_logits: Floats,
    grad_sh: Floats,
) -> None:
    """Gradients of the five parameters from the (tile, splat) sums of the rasteriser's backward pass.

    The rows ``pair_offsets[g]`` to ``pair_offsets[g + 1]`` of ``pair_sums`` belong to Gaussian ``g``;
    they are added in their order in float64, so nothing races and nothing depends on the threads.
    """
    n = means.shape[0]
    for block in prange((n + BLOCK - 1) // BLOCK):
        basis = np.empty(16, np.float32)
        weights = np.empty(16, np.float32)
        sums = np.empty(PAIR_COLUMNS, np.float64)
        for g in range(block * BLOCK, min(n, (block + 1) * BLOCK)):
            begin, end = pair_offsets[g], pair_offsets[g + 1]
            if begin == end:
                clear_gradients(g, grad_means, grad_log_scales, grad_rotations, grad_logits, grad_sh)
                continue
            sums[:] = 0.0
            for pair in range(begin, end):
                for column in range(pair_sums.shape[1]):
                    sums[column] += pair_sums[pair, column]
            backpropagate_one(
                g,
                means,
                log_scales,
                rotations,
                logits,
                sh,
                sh_count,
                view,
                antialias,
                splats,
                sums,
                grad_means,
                grad_log_scales,
                grad_rotations,
                grad_logits,
                grad_sh,
                basis,
                weights,
            )
