"""Compute the gradients of the raw parameters from the rasteriser's pixel sums.

This is the chain rule of ``projection``, written out with the symbols of its docstring.
"""

from __future__ import annotations

import math

import numpy as np
from numba import prange

from cleargs.splat.kernels import splat_layout as layout
from cleargs.splat.kernels.cpu.harmonics import sh_basis, sh_direction_gradient
from cleargs.splat.kernels.cpu.jit import inlined, kernel
from cleargs.splat.kernels.cpu.projection import (
    BLOCK,
    DILATION,
    QUATERNION_EPSILON,
    ZERO,
    Parameters,
    ProjectionView,
    Vector,
    camera_position,
    cross,
    direction_to,
    dot,
    mixed,
    own_view,
    projection_rows,
    residual,
    scaled_axes,
    unit_quaternion,
)
from cleargs.types import AnyArray, ArrayF32


@inlined
def plus(u: Vector, a: float, v: Vector) -> Vector:
    """Return u + a v."""
    return (u[0] + a * v[0], u[1] + a * v[1], u[2] + a * v[2])


@inlined
def quaternion_gradient(
    w: float, x: float, y: float, z: float, c0: Vector, c1: Vector, c2: Vector
) -> tuple[float, float, float, float]:
    """Return dL/d(unit quaternion) from the gradients c0, c1, c2 of the rotation matrix's columns."""
    return (
        2 * (x * (c1[2] - c2[1]) + y * (c2[0] - c0[2]) + z * (c0[1] - c1[0])),
        2 * (w * (c1[2] - c2[1]) + y * (c0[1] + c1[0]) + z * (c0[2] + c2[0]) - 2 * x * (c1[1] + c2[2])),
        2 * (w * (c2[0] - c0[2]) + x * (c0[1] + c1[0]) + z * (c1[2] + c2[1]) - 2 * y * (c0[0] + c2[2])),
        2 * (w * (c0[1] - c1[0]) + x * (c0[2] + c2[0]) + y * (c1[2] + c2[1]) - 2 * z * (c0[0] + c1[1])),
    )


@inlined
def colour_gradient(
    g: int,
    sh: ArrayF32,
    sh_count: int,
    splat: ArrayF32,
    direction: Vector,
    sums: AnyArray,
    grad_sh: ArrayF32,
    basis: ArrayF32,  # [16] scratch
    weights: ArrayF32,  # [16] scratch
) -> Vector:
    """Write dL/dSH of one Gaussian and return dL/d(direction); a clamped channel has no gradient."""
    red = np.float32(sums[layout.SUM_RED]) if splat[layout.RED] > ZERO else ZERO
    green = np.float32(sums[layout.SUM_GREEN]) if splat[layout.GREEN] > ZERO else ZERO
    blue = np.float32(sums[layout.SUM_BLUE]) if splat[layout.BLUE] > ZERO else ZERO
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


@inlined
def backpropagate_one(
    g: int,
    parameters: Parameters,
    sh_count: int,
    view: ProjectionView,
    antialias: bool,
    splats: ArrayF32,
    sums: AnyArray,  # [10] float64, columns splat_layout.SUM_*
    outputs: Parameters,
    basis: ArrayF32,  # [16] scratch
    weights: ArrayF32,  # [16] scratch
) -> None:
    """Apply the chain rule of ``project_one`` to the pixel sums of Gaussian ``g``."""
    means, log_scales, rotations, logits, sh = parameters
    grad_means, grad_log_scales, grad_rotations, grad_logits, grad_sh = outputs
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
    grad_mean_x = a * sums[layout.SUM_VU]
    grad_mean_y = e * sums[layout.SUM_VY] - k * grad_mean_x
    grad_logits[g] = sums[layout.SUM_V] / (1.0 + math.exp(np.float64(logits[g])))
    # d(ln alpha)/dk = a u dy,   dk = e [u1 · du0 + (w - k u1) · du1]
    by_k = e * a * sums[layout.SUM_VUY]
    # d(ln alpha)/ds = ½ a² u²,  ds = 2 w · (du0 - k du1)
    by_w = a * a * sums[layout.SUM_VUU]
    # d(ln alpha)/de = -½ dy²,   de = -2 e² u1 · du1
    by_yy = e * e * sums[layout.SUM_VYY]
    normal = (0.0, 0.0, 0.0)
    by_area = 0.0
    if antialias:
        # ln rho = ½ (ln |n|² - ln s - ln Σyy),  n = w x u1 = u0 x u1,
        # d ln |n|² = 2 [(u1 x n) · du0 + (n x u0) · du1] / |n|²
        by_w -= a * sums[layout.SUM_V]
        by_yy -= e * sums[layout.SUM_V]
        normal = cross(w, u1)
        by_area = sums[layout.SUM_V] / dot(normal, normal)
    side0, side1 = cross(u1, normal), cross(normal, u0)
    v0 = plus(mixed(by_w, w, by_k, u1), by_area, side0)
    v1 = plus(mixed(by_k - k * by_w, w, by_yy - k * by_k, u1), by_area, side1)
    # u0[i] = row0 · axis_i, axis_i = s_i R[:, i]
    m0, m1 = mixed(v0[0], row0, v1[0], row1), mixed(v0[1], row0, v1[1], row1)
    m2 = mixed(v0[2], row0, v1[2], row1)
    grad_log_scales[g, 0] = dot(m0, axis0)
    grad_log_scales[g, 1] = dot(m1, axis1)
    grad_log_scales[g, 2] = dot(m2, axis2)

    c0, c1 = (sx * m0[0], sx * m0[1], sx * m0[2]), (sy * m1[0], sy * m1[1], sy * m1[2])
    c2 = (sz * m2[0], sz * m2[1], sz * m2[2])
    gw, gx, gy, gz = quaternion_gradient(qw, qx, qy, qz, c0, c1, c2)
    # Normalisation removes the component along the quaternion, unless the norm was bounded from below.
    along = gw * qw + gx * qx + gy * qy + gz * qz if norm > QUATERNION_EPSILON else 0.0
    grad_rotations[g, 0] = (gw - along * qw) / norm
    grad_rotations[g, 1] = (gx - along * qx) / norm
    grad_rotations[g, 2] = (gy - along * qy) / norm
    grad_rotations[g, 3] = (gz - along * qz) / norm

    # row0 = jx W0 + jxz W2 with jx = fx/z, jxz = -fx cx/z, cx = clamp(x/z); row1 is analogous
    r0 = plus(mixed(v0[0], axis0, v0[1], axis1), v0[2], axis2)
    r1 = plus(mixed(v1[0], axis0, v1[1], axis1), v1[2], axis2)
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
        sums[layout.SUM_DEPTH]
        - (grad_tangent_x * tangent_x + grad_tangent_y * tangent_y) / z
        - (grad_jx - grad_jxz * bounded_x) * jx / z
        - (grad_jy - grad_jyz * bounded_y) * jy / z
    )
    camera_gradient = (grad_tangent_x / z, grad_tangent_y / z, grad_z)

    direction, distance = direction_to(means[g], view)
    towards = colour_gradient(g, sh, sh_count, splats[g], direction, sums, grad_sh, basis, weights)
    radial = dot(towards, direction)
    columns = (view.w00, view.w10, view.w20), (view.w01, view.w11, view.w21), (view.w02, view.w12, view.w22)
    for axis in range(3):
        turned = dot(columns[axis], camera_gradient)
        grad_means[g, axis] = turned + (towards[axis] - radial * direction[axis]) / distance


@kernel
def backpropagate(
    parameters: Parameters,
    sh_count: int,
    view: ProjectionView,
    poses: AnyArray,  # [N, 12] or [0, 12], see `own_view`
    antialias: bool,
    splats: ArrayF32,  # [N, 16]
    pair_offsets: AnyArray,  # [N + 1]
    pair_sums: ArrayF32,  # [P, 9 or 10]
    outputs: Parameters,  # written
) -> None:
    """Write the gradients of the five parameters, from the pair sums of the rasteriser's backward pass.

    The rows ``pair_offsets[g]`` to ``pair_offsets[g + 1]`` of ``pair_sums`` belong to Gaussian ``g``. They
    are added in order and in float64.
    """
    n = splats.shape[0]
    grad_means, grad_log_scales, grad_rotations, grad_logits, grad_sh = outputs
    for block in prange((n + BLOCK - 1) // BLOCK):
        basis = np.empty(16, np.float32)
        weights = np.empty(16, np.float32)
        sums = np.empty(layout.PAIR_COLUMNS, np.float64)
        for g in range(block * BLOCK, min(n, (block + 1) * BLOCK)):
            begin, end = pair_offsets[g], pair_offsets[g + 1]
            if begin == end:  # it touches no tile
                for axis in range(3):
                    grad_means[g, axis] = ZERO
                    grad_log_scales[g, axis] = ZERO
                for part in range(4):
                    grad_rotations[g, part] = ZERO
                grad_logits[g] = ZERO
                for k in range(grad_sh.shape[1]):
                    for channel in range(3):
                        grad_sh[g, k, channel] = ZERO
                continue
            sums[:] = 0.0
            for pair in range(begin, end):
                for column in range(pair_sums.shape[1]):
                    sums[column] += pair_sums[pair, column]
            own = own_view(g, view, poses)
            backpropagate_one(g, parameters, sh_count, own, antialias, splats, sums, outputs, basis, weights)
