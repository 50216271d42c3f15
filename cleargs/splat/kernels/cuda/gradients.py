"""Gradients of the raw parameters, from the rasteriser's sums over pixels.

The chain rule of ``projection``, as in the CPU back end's ``gradients``, in float64 except for the colours.
"""

from __future__ import annotations

import triton
import triton.language as tl

from cleargs.splat import constants
from cleargs.splat.kernels import splat_layout as layout
from cleargs.splat.kernels.cuda import device_layout
from cleargs.splat.kernels.cuda.harmonics import sh_basis, sh_by_x, sh_by_y, sh_by_z
from cleargs.splat.kernels.cuda.projection import (
    camera_position,
    combine,
    cross,
    dot,
    load_triple,
    pose_of,
    projection_rows,
    rotation_columns,
    scaled,
    unit_quaternion,
    view_triple,
)


@triton.jit(do_not_specialize=["n"])
def total(tile_counts, reached, pair_starts, pair_sums, totals, n, COLUMNS: tl.constexpr):
    """Add the pair sums of Gaussians with ``reached`` in float64, in the order of the slots.

    ``totals`` [COLUMNS, N] keep what they held for other Gaussians.
    """
    g = tl.program_id(0) * device_layout.TOTAL_ROWS + tl.arange(0, device_layout.TOTAL_ROWS)
    some = tl.load(reached + g, mask=g < n, other=0) > 0
    count = tl.load(tile_counts + g, mask=some, other=0)
    start = tl.load(pair_starts + g, mask=some, other=0).to(tl.int64)
    longest = tl.max(count, axis=0)
    for column in tl.static_range(COLUMNS):
        value = tl.zeros_like(start).to(tl.float64)
        for first in range(0, longest, device_layout.TOTAL_BLOCK):
            step = first + tl.arange(0, device_layout.TOTAL_BLOCK)
            own = step[None, :] < count[:, None]
            slot = start[:, None] + step[None, :]
            part = tl.load(pair_sums + slot * layout.PAIR_COLUMNS + column, mask=own, other=0.0)
            value += tl.sum(part.to(tl.float64), axis=1)
        tl.store(totals + column * n.to(tl.int64) + g, value, mask=some)


@triton.jit
def quaternion_gradient(q, c0, c1, c2):
    """Return dL/d(unit quaternion) from the gradients c0, c1, c2 of the rotation matrix's columns."""
    w, x, y, z = q[0], q[1], q[2], q[3]
    return (
        2.0 * (x * (c1[2] - c2[1]) + y * (c2[0] - c0[2]) + z * (c0[1] - c1[0])),
        2.0 * (w * (c1[2] - c2[1]) + y * (c0[1] + c1[0]) + z * (c0[2] + c2[0]) - 2.0 * x * (c1[1] + c2[2])),
        2.0 * (w * (c2[0] - c0[2]) + x * (c0[1] + c1[0]) + z * (c1[2] + c2[1]) - 2.0 * y * (c0[0] + c2[2])),
        2.0 * (w * (c0[1] - c1[0]) + x * (c0[2] + c2[0]) + y * (c1[2] + c2[1]) - 2.0 * z * (c0[0] + c1[1])),
    )


@triton.jit
def store_triple(pointer, triple, mask):
    """Store three numbers as float32."""
    for i in tl.static_range(3):
        tl.store(pointer + i, triple[i].to(tl.float32), mask=mask)


@triton.jit
def clear(gradients, reached, n, COLUMNS: tl.constexpr):
    """Store 0 in the rows [N, COLUMNS] of Gaussians without ``reached``.

    Neighbouring lanes store neighbouring numbers: most Gaussians may be hidden.
    """
    first = tl.program_id(0) * device_layout.PROJECT_BLOCK
    for part in tl.static_range(COLUMNS):
        i = part * device_layout.PROJECT_BLOCK + tl.arange(0, device_layout.PROJECT_BLOCK)
        g = first + i // COLUMNS
        hidden = tl.load(reached + g, mask=g < n, other=1) == 0
        tl.store(gradients + first * COLUMNS + i, tl.zeros_like(i).to(tl.float32), mask=hidden)


@triton.jit
def sum_of(totals, column: tl.constexpr, g, n, some):
    """Return one column of ``totals``; 0 for a Gaussian that is not in ``some``."""
    return tl.load(totals + column * n.to(tl.int64) + g, mask=some, other=0.0)


@triton.jit(do_not_specialize=["n"])
def backpropagate(
    means,
    log_scales,
    rotations,
    logits,
    sh,
    view,
    poses,
    splats,
    reached,
    totals,
    grad_means,
    grad_log_scales,
    grad_rotations,
    grad_logits,
    grad_sh,
    n,
    SH_STORED: tl.constexpr,
    SH_COUNT: tl.constexpr,
    ANTIALIAS: tl.constexpr,
    HAS_DEPTH: tl.constexpr,
    ROLLS: tl.constexpr,
):
    """Store the gradients of the five parameters. They are exactly 0 for Gaussians without ``reached``."""
    g = tl.program_id(0) * device_layout.PROJECT_BLOCK + tl.arange(0, device_layout.PROJECT_BLOCK)
    some = tl.load(reached + g, mask=g < n, other=0) > 0
    clear(grad_means, reached, n, 3)
    clear(grad_log_scales, reached, n, 3)
    clear(grad_rotations, reached, n, 4)
    clear(grad_logits, reached, n, 1)
    clear(grad_sh, reached, n, SH_STORED * 3)
    sum_v = sum_of(totals, layout.SUM_V, g, n, some)
    mean = load_triple(means + g * 3, some)
    pose = pose_of(view, poses, g, some, ROLLS)
    position = camera_position(mean, pose)
    x, y = position[0], position[1]
    z = tl.where(some, position[2], 1.0)
    position = (x, y, z)
    quaternion = unit_quaternion(rotations, g, some)
    columns = rotation_columns(quaternion)
    scales = load_triple(log_scales + g * 3, some)
    sx, sy, sz = tl.exp(scales[0]), tl.exp(scales[1]), tl.exp(scales[2])
    axis0, axis1, axis2 = scaled(sx, columns[0]), scaled(sy, columns[1]), scaled(sz, columns[2])
    rows = projection_rows(position, view, pose)
    row0, row1, bounded_x, bounded_y = rows[0], rows[1], rows[2], rows[3]
    u0 = (dot(row0, axis0), dot(row0, axis1), dot(row0, axis2))
    u1 = (dot(row1, axis0), dot(row1, axis1), dot(row1, axis2))
    e = 1.0 / (dot(u1, u1) + constants.DILATION)
    k = dot(u0, u1) * e
    w = combine(1.0, u0, -k, u1)
    a = 1.0 / (dot(w, w) + constants.DILATION * (1.0 + k * k))

    # ln alpha = ln opacity - ½ a u² - ½ e dy²,  u = dx - k dy
    grad_mean_x = a * sum_of(totals, layout.SUM_VU, g, n, some)
    grad_mean_y = e * sum_of(totals, layout.SUM_VY, g, n, some) - k * grad_mean_x
    logit = tl.load(logits + g, mask=some, other=0.0).to(tl.float64)
    grad_logit = sum_v / (1.0 + tl.exp(logit))
    # d(ln alpha)/dk = a u dy,   dk = e [u1 · du0 + (w - k u1) · du1]
    by_k = e * a * sum_of(totals, layout.SUM_VUY, g, n, some)
    # d(ln alpha)/ds = ½ a² u²,  ds = 2 w · (du0 - k du1)
    by_w = a * a * sum_of(totals, layout.SUM_VUU, g, n, some)
    # d(ln alpha)/de = -½ dy²,   de = -2 e² u1 · du1
    by_yy = e * e * sum_of(totals, layout.SUM_VYY, g, n, some)
    if ANTIALIAS:
        # ln rho = ½ (ln |n|² - ln s - ln Σyy),  n = w x u1 = u0 x u1,
        # d ln |n|² = 2 [(u1 x n) · du0 + (n x u0) · du1] / |n|²
        by_w -= a * sum_v
        by_yy -= e * sum_v
    v0 = combine(by_w, w, by_k, u1)
    v1 = combine(by_k - k * by_w, w, by_yy - k * by_k, u1)
    if ANTIALIAS:
        normal = cross(w, u1)
        by_area = sum_v / tl.where(some, dot(normal, normal), 1.0)
        v0 = combine(1.0, v0, by_area, cross(u1, normal))
        v1 = combine(1.0, v1, by_area, cross(normal, u0))
    # u0[i] = row0 · axis_i, axis_i = s_i R[:, i]
    m0 = combine(v0[0], row0, v1[0], row1)
    m1 = combine(v0[1], row0, v1[1], row1)
    m2 = combine(v0[2], row0, v1[2], row1)
    by_scales = (dot(m0, axis0), dot(m1, axis1), dot(m2, axis2))
    store_triple(grad_log_scales + g * 3, by_scales, some)
    tl.store(grad_logits + g, grad_logit.to(tl.float32), mask=some)

    by_quaternion = quaternion_gradient(quaternion, scaled(sx, m0), scaled(sy, m1), scaled(sz, m2))
    norm = quaternion[4]
    # Normalisation removes the component along the quaternion, unless the norm was bounded from below.
    along = by_quaternion[0] * quaternion[0]
    for i in tl.static_range(1, 4):
        along += by_quaternion[i] * quaternion[i]
    along = tl.where(norm > constants.QUATERNION_EPSILON, along, 0.0)
    for i in tl.static_range(4):
        value = (by_quaternion[i] - along * quaternion[i]) / norm
        tl.store(grad_rotations + g * 4 + i, value.to(tl.float32), mask=some)

    # row0 = jx W0 + jxz W2 with jx = fx/z, jxz = -fx cx/z, cx = clamp(x/z); row1 is analogous
    r0 = combine(1.0, combine(v0[0], axis0, v0[1], axis1), v0[2], axis2)
    r1 = combine(1.0, combine(v1[0], axis0, v1[1], axis1), v1[2], axis2)
    w0, w1, w2 = pose[0], pose[1], pose[2]
    grad_jx, grad_jxz, grad_jy, grad_jyz = dot(r0, w0), dot(r0, w2), dot(r1, w1), dot(r1, w2)
    fx, fy = tl.load(view + device_layout.VIEW_FX), tl.load(view + device_layout.VIEW_FY)
    jx, jy, tangent_x, tangent_y = fx / z, fy / z, x / z, y / z
    by_tangent_x = grad_mean_x * fx - tl.where(bounded_x == tangent_x, grad_jxz * jx, 0.0)
    by_tangent_y = grad_mean_y * fy - tl.where(bounded_y == tangent_y, grad_jyz * jy, 0.0)
    by_z = (
        -(by_tangent_x * tangent_x + by_tangent_y * tangent_y) / z
        - (grad_jx - grad_jxz * bounded_x) * jx / z
        - (grad_jy - grad_jyz * bounded_y) * jy / z
    )
    if HAS_DEPTH:
        by_z += sum_of(totals, layout.SUM_DEPTH, g, n, some)
    by_position = combine(1.0, combine(by_tangent_x / z, w0, by_tangent_y / z, w1), by_z, w2)

    centre = view_triple(view, device_layout.VIEW_CENTRE)
    offset = (mean[0] - centre[0], mean[1] - centre[1], mean[2] - centre[2])
    distance = tl.where(some, tl.sqrt(dot(offset, offset)), 1.0)
    direction = scaled(1.0 / distance, offset)
    row = splats + g * layout.SPLAT_COLUMNS
    # No gradient where the colour is clamped.
    lit_red = some & (tl.load(row + layout.RED, mask=some, other=0.0) > 0.0)
    lit_green = some & (tl.load(row + layout.GREEN, mask=some, other=0.0) > 0.0)
    lit_blue = some & (tl.load(row + layout.BLUE, mask=some, other=0.0) > 0.0)
    red = sum_of(totals, layout.SUM_RED, g, n, lit_red).to(tl.float32)
    green = sum_of(totals, layout.SUM_GREEN, g, n, lit_green).to(tl.float32)
    blue = sum_of(totals, layout.SUM_BLUE, g, n, lit_blue).to(tl.float32)
    dx, dy, dz = direction[0].to(tl.float32), direction[1].to(tl.float32), direction[2].to(tl.float32)
    basis = sh_basis(dx, dy, dz)
    by_x, by_y, by_d = sh_by_x(dx, dy, dz), sh_by_y(dx, dy, dz), sh_by_z(dx, dy, dz)
    zero = tl.zeros_like(red)
    towards_x, towards_y, towards_z = zero, zero, zero
    for i in tl.static_range(SH_STORED):
        at = (g * SH_STORED + i) * 3
        if i < SH_COUNT:
            shade = red * tl.load(sh + at, mask=some, other=0.0)
            shade += green * tl.load(sh + at + 1, mask=some, other=0.0)
            shade += blue * tl.load(sh + at + 2, mask=some, other=0.0)
            towards_x += shade * by_x[i]
            towards_y += shade * by_y[i]
            towards_z += shade * by_d[i]
            store_triple(grad_sh + at, (basis[i] * red, basis[i] * green, basis[i] * blue), some)
        else:
            store_triple(grad_sh + at, (zero, zero, zero), some)
    towards = (towards_x.to(tl.float64), towards_y.to(tl.float64), towards_z.to(tl.float64))
    radial = dot(towards, direction)
    for i in tl.static_range(3):
        value = by_position[i] + (towards[i] - radial * direction[i]) / distance
        tl.store(grad_means + g * 3 + i, value.to(tl.float32), mask=some)
