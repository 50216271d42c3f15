"""Compute the gradients of the raw parameters from the rasteriser's pixel sums.

This is the chain rule of ``projection``, written out with the symbols of its docstring. As there, geometry is
computed for rows of `GROUP` Gaussians in vector code, here those that touch a tile.
"""

from __future__ import annotations

import numpy as np
from numba import prange

from cleargs.splat.kernels import splat_layout as layout
from cleargs.splat.kernels.cpu.harmonics import FUNCTIONS, sh_basis, sh_direction_gradient
from cleargs.splat.kernels.cpu.jit import kernel, unfused
from cleargs.splat.kernels.cpu.lane_math import GROUP, exp
from cleargs.splat.kernels.cpu.projection import (
    BLOCK,
    DILATION,
    INPUT_ROWS,
    LOG_SCALES,
    LOGIT,
    MEAN,
    QUATERNION_EPSILON,
    ROTATION,
    ZERO,
    Parameters,
    ProjectionView,
    Vector,
    bounded,
    camera_position,
    cross,
    direction_to,
    dot,
    lane_quaternion,
    lane_view,
    mixed,
    projection_rows,
    read_gaussian,
    residual,
    scaled_axes,
    set_poses,
)
from cleargs.types import AnyArray, ArrayF32, ArrayF64

# Rows of the scratch memory after the inputs: sums, and the gradients that are written.
_SUMS = INPUT_ROWS
_COLOUR = _SUMS + layout.SUM_RED
_GRAD_MEAN = _SUMS + layout.PAIR_COLUMNS
_GRAD_LOG_SCALES, _GRAD_ROTATION, _GRAD_LOGIT = _GRAD_MEAN + 3, _GRAD_MEAN + 6, _GRAD_MEAN + 10
_DIRECTION = _GRAD_LOGIT + 1
_DISTANCE = _DIRECTION + 3
ROWS = _DISTANCE + 1


@unfused
def plus(u: Vector, a: float, v: Vector) -> Vector:
    """Return u + a v."""
    return (u[0] + a * v[0], u[1] + a * v[1], u[2] + a * v[2])


@unfused
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


@unfused
def gather(
    touching: AnyArray,
    first: int,
    last: int,
    parameters: Parameters,
    poses: AnyArray,
    splats: ArrayF32,
    pair_offsets: AnyArray,
    pair_sums: ArrayF32,
    rows: ArrayF64,
) -> None:
    """Write parameters and pixel sums of the next `GROUP` Gaussians of ``touching`` into ``rows``.

    They are those from ``first`` to at most ``last``. The pair sums are added in order and in float64.
    """
    columns = pair_sums.shape[1]
    sums = np.zeros(layout.PAIR_COLUMNS)
    for lane in range(GROUP):
        g = touching[min(first + lane, last)]
        read_gaussian(g, lane, parameters, poses, rows)
        sums[:] = 0.0
        for pair in range(pair_offsets[g], pair_offsets[g + 1]):
            for column in range(columns):
                sums[column] += pair_sums[pair, column]
        for column in range(layout.PAIR_COLUMNS):
            rows[_SUMS + column, lane] = sums[column]
        for channel in range(3):  # a clamped channel has no gradient
            if not splats[g, layout.RED + channel] > ZERO:
                rows[_COLOUR + channel, lane] = 0.0


@unfused
def backpropagate_lanes(view: ProjectionView, antialias: bool, rows: ArrayF64) -> None:
    """Apply the chain rule of ``project_lanes`` to the pixel sums in ``rows``.

    `colour_lanes` adds to the gradients of the means what depends on the colour, by the directions that are
    written here.
    """
    for lane in range(GROUP):
        own = lane_view(view, rows, lane)
        x, y, z = camera_position(rows[MEAN, lane], rows[MEAN + 1, lane], rows[MEAN + 2, lane], own)
        qw, qx, qy, qz, norm = lane_quaternion(rows, ROTATION, lane)
        sx, sy = exp(rows[LOG_SCALES, lane]), exp(rows[LOG_SCALES + 1, lane])
        sz = exp(rows[LOG_SCALES + 2, lane])
        axis0, axis1, axis2 = scaled_axes(qw, qx, qy, qz, sx, sy, sz)
        row0, row1 = projection_rows(x, y, z, own)
        u0 = (dot(row0, axis0), dot(row0, axis1), dot(row0, axis2))
        u1 = (dot(row1, axis0), dot(row1, axis1), dot(row1, axis2))
        yy = dot(u1, u1) + DILATION
        e = 1.0 / yy
        k = dot(u0, u1) * e
        w = residual(u0, u1, k)
        a = 1.0 / (dot(w, w) + DILATION * (1.0 + k * k))

        # ln alpha = ln opacity - ½ a u² - ½ e dy²,  u = dx - k dy
        grad_mean_x = a * rows[_SUMS + layout.SUM_VU, lane]
        grad_mean_y = e * rows[_SUMS + layout.SUM_VY, lane] - k * grad_mean_x
        by_alpha = rows[_SUMS + layout.SUM_V, lane]
        rows[_GRAD_LOGIT, lane] = by_alpha / (1.0 + exp(rows[LOGIT, lane]))
        # d(ln alpha)/dk = a u dy,   dk = e [u1 · du0 + (w - k u1) · du1]
        by_k = e * a * rows[_SUMS + layout.SUM_VUY, lane]
        # d(ln alpha)/ds = ½ a² u²,  ds = 2 w · (du0 - k du1)
        by_w = a * a * rows[_SUMS + layout.SUM_VUU, lane]
        # d(ln alpha)/de = -½ dy²,   de = -2 e² u1 · du1
        by_yy = e * e * rows[_SUMS + layout.SUM_VYY, lane]
        normal = (0.0, 0.0, 0.0)
        by_area = 0.0
        if antialias:
            # ln rho = ½ (ln |n|² - ln s - ln Σyy),  n = w x u1 = u0 x u1,
            # d ln |n|² = 2 [(u1 x n) · du0 + (n x u0) · du1] / |n|²
            by_w -= a * by_alpha
            by_yy -= e * by_alpha
            normal = cross(w, u1)
            by_area = by_alpha / dot(normal, normal)
        side0, side1 = cross(u1, normal), cross(normal, u0)
        v0 = plus(mixed(by_w, w, by_k, u1), by_area, side0)
        v1 = plus(mixed(by_k - k * by_w, w, by_yy - k * by_k, u1), by_area, side1)
        # u0[i] = row0 · axis_i, axis_i = s_i R[:, i]
        m0, m1 = mixed(v0[0], row0, v1[0], row1), mixed(v0[1], row0, v1[1], row1)
        m2 = mixed(v0[2], row0, v1[2], row1)
        rows[_GRAD_LOG_SCALES, lane] = dot(m0, axis0)
        rows[_GRAD_LOG_SCALES + 1, lane] = dot(m1, axis1)
        rows[_GRAD_LOG_SCALES + 2, lane] = dot(m2, axis2)

        c0, c1 = (sx * m0[0], sx * m0[1], sx * m0[2]), (sy * m1[0], sy * m1[1], sy * m1[2])
        c2 = (sz * m2[0], sz * m2[1], sz * m2[2])
        gw, gx, gy, gz = quaternion_gradient(qw, qx, qy, qz, c0, c1, c2)
        # Normalisation removes the component along the quaternion, unless the norm was bounded from below.
        along = gw * qw + gx * qx + gy * qy + gz * qz if norm > QUATERNION_EPSILON else 0.0
        rows[_GRAD_ROTATION, lane] = (gw - along * qw) / norm
        rows[_GRAD_ROTATION + 1, lane] = (gx - along * qx) / norm
        rows[_GRAD_ROTATION + 2, lane] = (gy - along * qy) / norm
        rows[_GRAD_ROTATION + 3, lane] = (gz - along * qz) / norm

        # row0 = jx W0 + jxz W2 with jx = fx/z, jxz = -fx cx/z, cx = clamp(x/z); row1 is analogous
        r0 = plus(mixed(v0[0], axis0, v0[1], axis1), v0[2], axis2)
        r1 = plus(mixed(v1[0], axis0, v1[1], axis1), v1[2], axis2)
        grad_jx = r0[0] * own.w00 + r0[1] * own.w01 + r0[2] * own.w02
        grad_jxz = r0[0] * own.w20 + r0[1] * own.w21 + r0[2] * own.w22
        grad_jy = r1[0] * own.w10 + r1[1] * own.w11 + r1[2] * own.w12
        grad_jyz = r1[0] * own.w20 + r1[1] * own.w21 + r1[2] * own.w22
        jx, jy, tangent_x, tangent_y = view.fx / z, view.fy / z, x / z, y / z
        bounded_x = bounded(tangent_x, view.left, view.right)
        bounded_y = bounded(tangent_y, view.top, view.bottom)
        grad_tangent_x = grad_mean_x * view.fx - (grad_jxz * jx if bounded_x == tangent_x else 0.0)
        grad_tangent_y = grad_mean_y * view.fy - (grad_jyz * jy if bounded_y == tangent_y else 0.0)
        grad_z = (
            rows[_SUMS + layout.SUM_DEPTH, lane]
            - (grad_tangent_x * tangent_x + grad_tangent_y * tangent_y) / z
            - (grad_jx - grad_jxz * bounded_x) * jx / z
            - (grad_jy - grad_jyz * bounded_y) * jy / z
        )
        seen = (grad_tangent_x / z, grad_tangent_y / z, grad_z)
        rows[_GRAD_MEAN, lane] = dot((own.w00, own.w10, own.w20), seen)
        rows[_GRAD_MEAN + 1, lane] = dot((own.w01, own.w11, own.w21), seen)
        rows[_GRAD_MEAN + 2, lane] = dot((own.w02, own.w12, own.w22), seen)
        direction, distance = direction_to(rows[MEAN, lane], rows[MEAN + 1, lane], rows[MEAN + 2, lane], view)
        rows[_DIRECTION, lane], rows[_DIRECTION + 1, lane], rows[_DIRECTION + 2, lane] = direction
        rows[_DISTANCE, lane] = distance


@unfused
def colour_lanes(
    touching: AnyArray,
    first: int,
    last: int,
    sh: ArrayF32,
    sh_count: int,
    rows: ArrayF64,
    basis: ArrayF32,  # [16, lanes], written
    weights: ArrayF32,  # [16, lanes] scratch
) -> None:
    """Write the SH basis of the lanes, and add dL/d(mean) by the colour to ``rows``."""
    for lane in range(GROUP):
        g = touching[min(first + lane, last)]
        red, green, blue = rows[_COLOUR, lane], rows[_COLOUR + 1, lane], rows[_COLOUR + 2, lane]
        by_red, by_green, by_blue = np.float32(red), np.float32(green), np.float32(blue)
        for k in range(1, sh_count):
            weights[k, lane] = sh[g, k, 0] * by_red + sh[g, k, 1] * by_green + sh[g, k, 2] * by_blue
    for k in range(sh_count, FUNCTIONS):
        for lane in range(GROUP):
            weights[k, lane] = ZERO
    for lane in range(GROUP):
        direction = rows[_DIRECTION, lane], rows[_DIRECTION + 1, lane], rows[_DIRECTION + 2, lane]
        x, y, z = np.float32(direction[0]), np.float32(direction[1]), np.float32(direction[2])
        sh_basis(x, y, z, basis, lane)
        gx, gy, gz = sh_direction_gradient(x, y, z, weights, lane)
        towards = np.float64(gx), np.float64(gy), np.float64(gz)
        radial, distance = dot(towards, direction), rows[_DISTANCE, lane]
        rows[_GRAD_MEAN, lane] += (towards[0] - radial * direction[0]) / distance
        rows[_GRAD_MEAN + 1, lane] += (towards[1] - radial * direction[1]) / distance
        rows[_GRAD_MEAN + 2, lane] += (towards[2] - radial * direction[2]) / distance


@unfused
def write_gradients(
    g: int, lane: int, sh_count: int, rows: ArrayF64, basis: ArrayF32, outputs: Parameters
) -> None:
    """Write the gradients of one Gaussian."""
    grad_means, grad_log_scales, grad_rotations, grad_logits, grad_sh = outputs
    for axis in range(3):
        grad_means[g, axis] = rows[_GRAD_MEAN + axis, lane]
        grad_log_scales[g, axis] = rows[_GRAD_LOG_SCALES + axis, lane]
    for part in range(4):
        grad_rotations[g, part] = rows[_GRAD_ROTATION + part, lane]
    grad_logits[g] = rows[_GRAD_LOGIT, lane]
    red, green = np.float32(rows[_COLOUR, lane]), np.float32(rows[_COLOUR + 1, lane])
    blue = np.float32(rows[_COLOUR + 2, lane])
    for k in range(sh_count):
        value = basis[k, lane]
        grad_sh[g, k, 0] = value * red
        grad_sh[g, k, 1] = value * green
        grad_sh[g, k, 2] = value * blue
    for k in range(sh_count, grad_sh.shape[1]):
        for channel in range(3):
            grad_sh[g, k, channel] = ZERO


@unfused
def write_zeros(g: int, outputs: Parameters) -> None:
    grad_means, grad_log_scales, grad_rotations, grad_logits, grad_sh = outputs
    for axis in range(3):
        grad_means[g, axis] = ZERO
        grad_log_scales[g, axis] = ZERO
    for part in range(4):
        grad_rotations[g, part] = ZERO
    grad_logits[g] = ZERO
    for k in range(grad_sh.shape[1]):
        for channel in range(3):
            grad_sh[g, k, channel] = ZERO


@kernel
def backpropagate(
    parameters: Parameters,
    sh_count: int,
    view: ProjectionView,
    poses: AnyArray,  # [N, 12] or [0, 12], see `project`
    antialias: bool,
    splats: ArrayF32,  # [N, 16]
    pair_offsets: AnyArray,  # [N + 1]
    pair_sums: ArrayF32,  # [P, 9 or 10]
    outputs: Parameters,  # written
) -> None:
    """Write the gradients of the five parameters, from the pair sums of the rasteriser's backward pass.

    The rows ``pair_offsets[g]`` to ``pair_offsets[g + 1]`` of ``pair_sums`` belong to Gaussian ``g``. A
    Gaussian that touches no tile gets 0.
    """
    n = splats.shape[0]
    for block in prange((n + BLOCK - 1) // BLOCK):
        rows, touching = np.empty((ROWS, GROUP)), np.empty(BLOCK, np.int64)
        basis = np.empty((FUNCTIONS, GROUP), np.float32)
        weights = np.empty((FUNCTIONS, GROUP), np.float32)
        set_poses(view, rows)
        count = 0
        for g in range(block * BLOCK, min(n, (block + 1) * BLOCK)):
            if pair_offsets[g] == pair_offsets[g + 1]:
                write_zeros(g, outputs)
            else:
                touching[count] = g
                count += 1
        for first in range(0, count, GROUP):
            gather(touching, first, count - 1, parameters, poses, splats, pair_offsets, pair_sums, rows)
            backpropagate_lanes(view, antialias, rows)
            colour_lanes(touching, first, count - 1, parameters[4], sh_count, rows, basis, weights)
            for lane in range(min(GROUP, count - first)):
                g = touching[first + lane]
                write_gradients(g, lane, sh_count, rows, basis, outputs)
