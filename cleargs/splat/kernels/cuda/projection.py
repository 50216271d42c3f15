"""Packed splats from raw Gaussian parameters. ``gradients`` is the backward pass.

EWA splatting as in the CPU back end, whose ``projection`` derives the formulas. With U = J W R diag(s), its
rows u0 and u1, and k = Σxy / Σyy, the ellipse needs s = |u0 - k u1|² + 0.3 (1 + k²) and Σyy only, without
cancellation. Geometry is computed in float64, colours in float32. A lane is a Gaussian.
"""

from __future__ import annotations

import triton
import triton.language as tl

from cleargs.splat import constants
from cleargs.splat.kernels import splat_layout as layout
from cleargs.splat.kernels.cuda import device_layout
from cleargs.splat.kernels.cuda.binning import count_tiles
from cleargs.splat.kernels.cuda.harmonics import sh_basis


@triton.jit
def dot(a, b):
    """Return the scalar product of two triples."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@triton.jit
def cross(a, b):
    """Return the vector product of two triples."""
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


@triton.jit
def combine(a, x, b, y):
    """Return the triple a x + b y."""
    return (a * x[0] + b * y[0], a * x[1] + b * y[1], a * x[2] + b * y[2])


@triton.jit
def is_finite(x):
    """Return True within the range of float32; False for NaN."""
    return tl.abs(x) <= device_layout.FLOAT32_MAX


@triton.jit
def load_triple(pointer, mask):
    """Return three consecutive float32 as float64."""
    return (
        tl.load(pointer, mask=mask, other=0.0).to(tl.float64),
        tl.load(pointer + 1, mask=mask, other=0.0).to(tl.float64),
        tl.load(pointer + 2, mask=mask, other=0.0).to(tl.float64),
    )


@triton.jit
def view_triple(view, at: tl.constexpr):
    """Return three consecutive numbers of a view."""
    return (tl.load(view + at), tl.load(view + at + 1), tl.load(view + at + 2))


@triton.jit
def pose_of(view, poses, g, mask, ROLLS: tl.constexpr):
    """Return the rows of the rotation and the shift: of the view, or with ``ROLLS`` of each Gaussian."""
    if ROLLS:
        first = poses + g * 12
        return (
            load_row(first, mask),
            load_row(first + 3, mask),
            load_row(first + 6, mask),
            load_row(first + 9, mask),
        )
    else:
        return (
            view_triple(view, device_layout.VIEW_ROTATION),
            view_triple(view, device_layout.VIEW_ROTATION + 3),
            view_triple(view, device_layout.VIEW_ROTATION + 6),
            view_triple(view, device_layout.VIEW_TRANSLATION),
        )


@triton.jit
def load_row(pointer, mask):
    """Return three consecutive float64 per Gaussian."""
    return (
        tl.load(pointer, mask=mask, other=0.0),
        tl.load(pointer + 1, mask=mask, other=0.0),
        tl.load(pointer + 2, mask=mask, other=0.0),
    )


@triton.jit
def camera_position(mean, pose):
    """Return the Gaussian's centre in camera coordinates."""
    shift = pose[3]
    return (dot(pose[0], mean) + shift[0], dot(pose[1], mean) + shift[1], dot(pose[2], mean) + shift[2])


@triton.jit
def unit_quaternion(rotations, g, mask):
    """Return the normalised quaternion w x y z, and the norm."""
    w = tl.load(rotations + g * 4, mask=mask, other=1.0).to(tl.float64)
    x = tl.load(rotations + g * 4 + 1, mask=mask, other=0.0).to(tl.float64)
    y = tl.load(rotations + g * 4 + 2, mask=mask, other=0.0).to(tl.float64)
    z = tl.load(rotations + g * 4 + 3, mask=mask, other=0.0).to(tl.float64)
    length = tl.sqrt(w * w + x * x + y * y + z * z)
    # Not tl.maximum, which would hide a NaN.
    norm = tl.where(length < constants.QUATERNION_EPSILON, constants.QUATERNION_EPSILON, length)
    return (w / norm, x / norm, y / norm, z / norm, norm)


@triton.jit
def rotation_columns(q):
    """Return the columns of the rotation matrix of a unit quaternion."""
    w, x, y, z = q[0], q[1], q[2], q[3]
    return (
        (1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y)),
        (2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x)),
        (2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y)),
    )


@triton.jit
def projection_rows(position, view, pose):
    """Return the rows of J W, and the bounded x/z and y/z of J."""
    x, y, z = position[0], position[1], position[2]
    jx, jy = tl.load(view + device_layout.VIEW_FX) / z, tl.load(view + device_layout.VIEW_FY) / z
    left, right = tl.load(view + device_layout.VIEW_LEFT), tl.load(view + device_layout.VIEW_RIGHT)
    top, bottom = tl.load(view + device_layout.VIEW_TOP), tl.load(view + device_layout.VIEW_BOTTOM)
    tangent_x = tl.minimum(tl.maximum(x / z, left), right)
    tangent_y = tl.minimum(tl.maximum(y / z, top), bottom)
    row0 = combine(jx, pose[0], -jx * tangent_x, pose[2])
    row1 = combine(jy, pose[1], -jy * tangent_y, pose[2])
    return (row0, row1, tangent_x, tangent_y)


@triton.jit
def scaled(factor, a):
    """Return the triple times a number."""
    return (factor * a[0], factor * a[1], factor * a[2])


@triton.jit(do_not_specialize=["n", "width", "height"])
def project(
    means,
    log_scales,
    rotations,
    logits,
    sh,
    view,
    poses,
    splats,
    depth_keys,
    tile_counts,
    reached,
    radii,
    n,
    width,
    height,
    SH_STORED: tl.constexpr,
    SH_COUNT: tl.constexpr,
    ANTIALIAS: tl.constexpr,
    ROLLS: tl.constexpr,
):
    """Store packed splats [N, 16], depth keys [N], numbers of touched tiles [N] int32 and radii [N] in px.

    ``reached`` [N] is set to 0, for ``rasterise.forward``.

    A Gaussian is culled if it is behind the near plane, too faint, not finite, or touches no tile. Its key is
    then infinity, its count and its radius are 0. Launch it without fused multiply and add, as
    ``binning.list_pairs``, which must find the same tiles.
    """
    g = tl.program_id(0) * device_layout.PROJECT_BLOCK + tl.arange(0, device_layout.PROJECT_BLOCK)
    mask = g < n
    mean = load_triple(means + g * 3, mask)
    pose = pose_of(view, poses, g, mask, ROLLS)
    position = camera_position(mean, pose)
    z = position[2]
    visible = mask & (z >= constants.NEAR) & (z <= device_layout.FLOAT32_MAX)
    # Culled lanes continue with harmless numbers.
    position = (position[0], position[1], tl.where(visible, z, 1.0))
    z = position[2]
    quaternion = unit_quaternion(rotations, g, mask)
    axes = rotation_columns(quaternion)
    scales = load_triple(log_scales + g * 3, mask)
    sx, sy, sz = tl.exp(scales[0]), tl.exp(scales[1]), tl.exp(scales[2])
    rows = projection_rows(position, view, pose)
    u0 = (dot(rows[0], axes[0]) * sx, dot(rows[0], axes[1]) * sy, dot(rows[0], axes[2]) * sz)
    u1 = (dot(rows[1], axes[0]) * sx, dot(rows[1], axes[1]) * sy, dot(rows[1], axes[2]) * sz)
    xx, xy, yy = dot(u0, u0) + constants.DILATION, dot(u0, u1), dot(u1, u1) + constants.DILATION
    skew = xy / yy
    w = combine(1.0, u0, -skew, u1)
    variance = dot(w, w) + constants.DILATION * (1.0 + skew * skew)
    logit = tl.load(logits + g, mask=mask, other=0.0).to(tl.float64)
    log2_opacity = -tl.log2(1.0 + tl.exp(-logit))
    if ANTIALIAS:
        normal = cross(w, u1)
        log2_opacity += 0.5 * tl.log2(dot(normal, normal) / (variance * yy))
    mean_x = tl.load(view + device_layout.VIEW_FX) * position[0] / z + tl.load(view + device_layout.VIEW_CX)
    mean_y = tl.load(view + device_layout.VIEW_FY) * position[1] / z + tl.load(view + device_layout.VIEW_CY)
    reach = device_layout.TWO_LN2 * (log2_opacity - constants.LOG2_ALPHA_CUT)
    visible = visible & (reach >= 0.0) & is_finite(variance) & is_finite(xx) & is_finite(yy)
    visible = visible & is_finite(mean_x) & is_finite(mean_y)

    row = splats + g * layout.SPLAT_COLUMNS
    # Rounded once, here: the tiles are counted from the stored numbers.
    mean_x, mean_y = mean_x.to(tl.float32), mean_y.to(tl.float32)
    bend_x, bend_y = (
        (device_layout.HALF_LOG2E / variance).to(tl.float32),
        (device_layout.HALF_LOG2E / yy).to(tl.float32),
    )
    skew, log2_opacity = skew.to(tl.float32), log2_opacity.to(tl.float32)
    extent_x, extent_y = tl.sqrt(reach * xx).to(tl.float32), tl.sqrt(reach * yy).to(tl.float32)
    extent_x_at = (xy * tl.sqrt(reach / xx)).to(tl.float32)
    ellipse = (mean_x, mean_y, bend_x, skew, bend_y, log2_opacity, extent_y, extent_x_at)
    tiles = count_tiles(ellipse, visible, width, height)
    touches = tiles > 0

    centre = view_triple(view, device_layout.VIEW_CENTRE)
    towards = (mean[0] - centre[0], mean[1] - centre[1], mean[2] - centre[2])
    distance = tl.sqrt(dot(towards, towards))
    basis = sh_basis(
        (towards[0] / distance).to(tl.float32),
        (towards[1] / distance).to(tl.float32),
        (towards[2] / distance).to(tl.float32),
    )
    zero = tl.zeros_like(g).to(tl.float32)
    red, green, blue = zero, zero, zero
    for k in tl.static_range(SH_COUNT):
        coefficient = sh + (g * SH_STORED + k) * 3
        red += basis[k] * tl.load(coefficient, mask=touches, other=0.0)
        green += basis[k] * tl.load(coefficient + 1, mask=touches, other=0.0)
        blue += basis[k] * tl.load(coefficient + 2, mask=touches, other=0.0)
    touches = touches & is_finite(red) & is_finite(green) & is_finite(blue)

    tl.store(row + layout.MEAN_X, mean_x, mask=touches)
    tl.store(row + layout.MEAN_Y, mean_y, mask=touches)
    tl.store(row + layout.BEND_X, bend_x, mask=touches)
    tl.store(row + layout.SKEW, skew, mask=touches)
    tl.store(row + layout.BEND_Y, bend_y, mask=touches)
    tl.store(row + layout.LOG2_OPACITY, log2_opacity, mask=touches)
    tl.store(row + layout.RED, tl.maximum(red + constants.SH_OFFSET, 0.0), mask=touches)
    tl.store(row + layout.GREEN, tl.maximum(green + constants.SH_OFFSET, 0.0), mask=touches)
    tl.store(row + layout.BLUE, tl.maximum(blue + constants.SH_OFFSET, 0.0), mask=touches)
    if ROLLS:  # different poses would mix the order of Gaussians on one surface
        still = camera_position(mean, pose_of(view, poses, g, mask, False))
        z = tl.maximum(still[2], constants.NEAR)
    tl.store(row + layout.DEPTH, z.to(tl.float32), mask=touches)
    tl.store(row + layout.EXTENT_X, extent_x, mask=touches)
    tl.store(row + layout.EXTENT_Y, extent_y, mask=touches)
    tl.store(row + layout.EXTENT_X_AT, extent_x_at, mask=touches)

    tl.store(tile_counts + g, tl.where(touches, tiles, 0), mask=mask)
    tl.store(reached + g, tl.zeros_like(tiles), mask=mask)
    tl.store(depth_keys + g, tl.where(touches, z.to(tl.float32), float("inf")), mask=mask)
    tl.store(radii + g, tl.where(touches, tl.maximum(extent_x, extent_y), 0.0), mask=mask)
