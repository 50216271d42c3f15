"""Blur, rolling shutter and defocus as one warp, and its transpose.

The mathematics is that of the CPU back end's ``frame_warp``. A lane is a pixel of the formed image, in both
directions. In the transpose, each pixel adds its light to the pixels that it sampled. Many pixels add to the
same one, in no fixed order. Light is therefore added in integer multiples of a small unit: the sum does not
depend on the order, and the transpose gives the same bits each time.
"""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from cleargs.splat.kernels import warp_layout as layout
from cleargs.splat.kernels.cuda.support import memory_errors
from cleargs.splat.kernels.warp_layout import CHANNELS, DisplacementFields

BLOCK = 128

SUM_BITS = 61
"""Bits of the largest sum in a pixel. The weights of cubic interpolation can make it 25/16 as large."""

LEAST_LIGHT = 1e-18
"""Lower limit of the brightest light. The unit of the sums is a fraction of the brightest light."""


@triton.jit
def twist_of(motion, part):
    """Return a twist of a frame's motion, by its number in ``warp_layout``."""
    first = motion + layout.TWISTS + 6 * part
    tx, ty, tz = tl.load(first), tl.load(first + 1), tl.load(first + 2)
    return tx, ty, tz, tl.load(first + 3), tl.load(first + 4), tl.load(first + 5)


@triton.jit
def flow(x, y, near, twist):
    """Return the displacement of a pixel on the ray (x, y, 1) under a twist, px if fy is equal to fx."""
    tx, ty, tz, rx, ry, rz = twist
    along_x = near * (x * tz - tx) + x * y * rx - (1.0 + x * x) * ry + y * rz
    along_y = near * (y * tz - ty) + (1.0 + y * y) * rx - x * y * ry - x * rz
    return along_x, along_y


@triton.jit
def nearness(depth, alpha, at, inside, median):
    """Return the median depth over the depths of the pixels ``at``; 1 where they have none."""
    covered = tl.load(alpha + at, mask=inside, other=0.0)
    behind = tl.load(depth + at, mask=inside, other=0.0)
    seen = (covered > layout.MIN_COVERED) & (behind > 0.0)  # false for NaN
    return tl.where(
        seen, tl.minimum(median * covered / tl.where(seen, behind, 1.0), layout.MAX_NEARNESS), 1.0
    )


@triton.jit
def twist_at(motion, read):
    """Return the twist of pixels that are read at ``read``, from -1/2 to 1/2: pose and skew."""
    px, py, pz, qx, qy, qz = twist_of(motion, 0)
    tx, ty, tz, rx, ry, rz = twist_of(motion, 2)
    ux, uy, uz, vx, vy, vz = twist_of(motion, 3)
    return (
        px + read * (tx + read * ux),
        py + read * (ty + read * uy),
        pz + read * (tz + read * uz),
        qx + read * (rx + read * vx),
        qy + read * (ry + read * vy),
        qz + read * (rz + read * vz),
    )


@triton.jit(do_not_specialize=["height", "width", "margin"])
def displace(
    depth,
    alpha,
    motion,
    offset,
    sweep,
    radius,
    curve,
    height,
    width,
    margin,
    READ_STEPS: tl.constexpr,
    CURVED: tl.constexpr,
    BLOCK: tl.constexpr,
):
    """Store the fields of a frame's motion and defocus; depth, alpha [H + 2 margin, W + 2 margin].

    ``curve`` is written where ``CURVED``. ``READ_STEPS`` is that of ``warp_layout``; 0: a global shutter.
    """
    pixel = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    plane = height * width
    inside = pixel < plane
    row, column = pixel // width, pixel % width
    rows, columns = height + 2 * margin, width + 2 * margin
    median = tl.load(motion + layout.MEDIAN)
    near = nearness(depth, alpha, (row + margin) * columns + column + margin, inside, median)
    fx, fy = tl.load(motion + layout.FX), tl.load(motion + layout.FY)
    x = (column.to(tl.float32) + 0.5 - tl.load(motion + layout.CX)) / fx
    y = (row.to(tl.float32) + 0.5 - tl.load(motion + layout.CY)) / fy
    down = (row.to(tl.float32) + 0.5) / height - 0.5
    across = (column.to(tl.float32) + 0.5) / width - 0.5
    read = tl.load(motion + layout.READ_DOWN) * down + tl.load(motion + layout.READ_ACROSS) * across
    # Pose and skew give the offset, blur gives the sweep.
    moved = twist_at(motion, read)
    offset_x, offset_y = flow(x, y, near, moved)
    for _ in tl.static_range(READ_STEPS):
        lower = row.to(tl.float32) + margin + offset_y * (fy / fx) + 0.5
        right = column.to(tl.float32) + margin + offset_x + 0.5
        lower = tl.minimum(tl.maximum(lower, 0.0), (rows - 1).to(tl.float32)).to(tl.int32)
        right = tl.minimum(tl.maximum(right, 0.0), (columns - 1).to(tl.float32)).to(tl.int32)
        there = nearness(depth, alpha, lower * columns + right, inside, median)
        offset_x, offset_y = flow(x + 0.5 * offset_x / fx, y + 0.5 * offset_y / fx, there, moved)
    tl.store(offset + pixel, offset_x, mask=inside)
    tl.store(offset + plane + pixel, offset_y * (fy / fx), mask=inside)
    blur_x, blur_y = flow(x, y, near, twist_of(motion, 1))
    tl.store(sweep + pixel, blur_x, mask=inside)
    tl.store(sweep + plane + pixel, blur_y * (fy / fx), mask=inside)
    if CURVED:
        for part in tl.static_range(2):
            along_x, along_y = flow(x, y, near, twist_of(motion, 4 + part))
            tl.store(curve + 2 * part * plane + pixel, along_x, mask=inside)
            tl.store(curve + (2 * part + 1) * plane + pixel, along_y * (fy / fx), mask=inside)
    disc = tl.load(motion + layout.DISC) * tl.abs(near - tl.load(motion + layout.FOCUS))
    tl.store(radius + pixel, disc, mask=inside)


@triton.jit
def sampled_places(pixel, inside, offset, sweep, radius, height, width, margin):
    """Return the mean places that pixels sample, x and y, their sweeps, and the radii of their discs, px."""
    plane = height * width
    x = (pixel % width + margin).to(tl.float32) + tl.load(offset + pixel, mask=inside, other=0.0)
    y = (pixel // width + margin).to(tl.float32) + tl.load(offset + plane + pixel, mask=inside, other=0.0)
    along_x = tl.load(sweep + pixel, mask=inside, other=0.0)
    along_y = tl.load(sweep + plane + pixel, mask=inside, other=0.0)
    return x, y, along_x, along_y, tl.load(radius + pixel, mask=inside, other=0.0)


@triton.jit
def curve_at(pixel, inside, curve, plane, CURVED: tl.constexpr):
    """Return bend and cube of pixels, each as x and y; zeros where the paths are straight."""
    if CURVED:
        bend_x = tl.load(curve + pixel, mask=inside, other=0.0)
        bend_y = tl.load(curve + plane + pixel, mask=inside, other=0.0)
        cube_x = tl.load(curve + 2 * plane + pixel, mask=inside, other=0.0)
        cube_y = tl.load(curve + 3 * plane + pixel, mask=inside, other=0.0)
        return bend_x, bend_y, cube_x, cube_y
    else:
        return 0.0, 0.0, 0.0, 0.0


@triton.jit
def deviation(t, bend, cube):
    """Return the displacement from the straight path at time ``t`` of the exposure, along one axis."""
    return (t * t - 1.0 / 12.0) * bend + t * (t * t - 3.0 / 20.0) * cube


@triton.jit
def between(position, count):
    """Return the first of the two pixels around ``position``, of ``count``, and the weight of the second."""
    last = (count - 1).to(tl.float32)
    position = tl.minimum(tl.maximum(position, 0.0), last)
    first = tl.minimum(position, tl.maximum(last - 1.0, 0.0)).to(tl.int32)
    return first, position - first.to(tl.float32)


@triton.jit
def shares(a, TAPS: tl.constexpr):
    """Return the weights of the pixels around a position.

    It is ``a`` pixels after the first of two, or the second of four. The four weights are those of Keys,
    "Cubic convolution interpolation for digital image processing" (1981), with the parameter -1/2.
    """
    b = 1.0 - a
    if TAPS == 2:
        return b, a
    else:
        inner = 0.5 * a * b
        return -inner * b, b + inner * (b + b - a), a + inner * (a + a - b), -inner * a


@triton.jit
def neighbour(first, tap: tl.constexpr, count, TAPS: tl.constexpr):
    """Return the index of a pixel that has a weight; outside the image, that of the nearest border pixel."""
    return tl.minimum(tl.maximum(first + (tap - (TAPS // 2 - 1)), 0), count - 1)


@triton.jit(do_not_specialize=["height", "width", "margin", "count"])
def gather_light(
    image,
    offset,
    sweep,
    radius,
    curve,
    samples,
    light,
    height,
    width,
    margin,
    count,
    share,
    TAPS: tl.constexpr,
    CURVED: tl.constexpr,
    BLOCK: tl.constexpr,
):
    """Store the light that the sensor gathers from a still image, ``light`` [H, W, 4].

    ``image`` [H + 2 margin, W + 2 margin, 4] is linear. ``share`` is the weight of each of ``count`` samples.
    """
    pixel = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside = pixel < height * width
    channel = tl.arange(0, layout.CHANNELS)[None, :]
    rows, columns = height + 2 * margin, width + 2 * margin
    x, y, along_x, along_y, wide = sampled_places(pixel, inside, offset, sweep, radius, height, width, margin)
    bend_x, bend_y, cube_x, cube_y = curve_at(pixel, inside, curve, height * width, CURVED)
    shape: tl.constexpr = [BLOCK, layout.CHANNELS]
    total = tl.zeros(shape, tl.float32)
    for k in range(0, count):
        t, u, v = tl.load(samples + 3 * k), tl.load(samples + 3 * k + 1), tl.load(samples + 3 * k + 2)
        at_x, at_y = x + t * along_x + u * wide, y + t * along_y + v * wide
        if CURVED:
            at_x, at_y = at_x + deviation(t, bend_x, cube_x), at_y + deviation(t, bend_y, cube_y)
        i, a = between(at_x, columns)
        j, b = between(at_y, rows)
        across, down = shares(a, TAPS), shares(b, TAPS)
        for m in tl.static_range(TAPS):
            for n in tl.static_range(TAPS):
                at = neighbour(j, m, rows, TAPS) * columns + neighbour(i, n, columns, TAPS)
                part = (down[m] * across[n])[:, None]
                total += part * tl.load(image + at[:, None] * layout.CHANNELS + channel)
    here = light + pixel[:, None] * layout.CHANNELS + channel
    tl.store(here, total * share, mask=inside[:, None])


@triton.jit(do_not_specialize=["height", "width", "margin", "count"])
def return_light(
    light,
    offset,
    sweep,
    radius,
    curve,
    samples,
    scale,
    sums,
    height,
    width,
    margin,
    count,
    TAPS: tl.constexpr,
    CURVED: tl.constexpr,
    BLOCK: tl.constexpr,
):
    """Add ``light`` times ``scale`` to ``sums`` (int64): the transpose of `gather_light`."""
    pixel = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside = pixel < height * width
    channel = tl.arange(0, layout.CHANNELS)[None, :]
    rows, columns = height + 2 * margin, width + 2 * margin
    x, y, along_x, along_y, wide = sampled_places(pixel, inside, offset, sweep, radius, height, width, margin)
    bend_x, bend_y, cube_x, cube_y = curve_at(pixel, inside, curve, height * width, CURVED)
    coloured = inside[:, None] & (channel < 3)
    seen = tl.load(light + pixel[:, None] * layout.CHANNELS + channel, mask=coloured, other=0.0)
    seen *= tl.load(scale)
    for k in range(0, count):
        t, u, v = tl.load(samples + 3 * k), tl.load(samples + 3 * k + 1), tl.load(samples + 3 * k + 2)
        at_x, at_y = x + t * along_x + u * wide, y + t * along_y + v * wide
        if CURVED:
            at_x, at_y = at_x + deviation(t, bend_x, cube_x), at_y + deviation(t, bend_y, cube_y)
        i, a = between(at_x, columns)
        j, b = between(at_y, rows)
        across, down = shares(a, TAPS), shares(b, TAPS)
        for m in tl.static_range(TAPS):
            for n in tl.static_range(TAPS):
                at = neighbour(j, m, rows, TAPS) * columns + neighbour(i, n, columns, TAPS)
                units = (seen * (down[m] * across[n])[:, None]).to(tl.int64)
                tl.atomic_add(
                    sums + at[:, None] * layout.CHANNELS + channel, units, mask=coloured, sem="relaxed"
                )


@triton.jit(do_not_specialize=["pixels"])
def follow_curve(image, curve, out, slope, pixels, FROM: tl.constexpr, TO: tl.constexpr, BLOCK: tl.constexpr):
    """Map an image [pixels, FROM] through a curve to [pixels, TO]; store the curve's slopes [pixels, 3]."""
    pixel = (tl.program_id(0) * BLOCK + tl.arange(0, BLOCK))[:, None]
    channel = tl.arange(0, layout.CHANNELS)[None, :]
    coloured = (pixel < pixels) & (channel < 3)
    place = tl.load(image + pixel * FROM + channel, mask=coloured, other=0.0) * layout.CURVE_DENSITY
    index = tl.minimum(tl.maximum(place, 0.0), layout.CURVE_STEPS - 1).to(tl.int32)
    low = tl.load(curve + index)
    rise = tl.load(curve + index + 1) - low
    value = low + (place - index.to(tl.float32)) * rise
    tl.store(slope + pixel * 3 + channel, rise * layout.CURVE_DENSITY, mask=coloured)
    padded = tl.where(channel < 3, value, 0.0)
    tl.store(out + pixel * TO + channel, padded, mask=(pixel < pixels) & (channel < TO))


@memory_errors()
def displacements(depth: Tensor, alpha: Tensor, motion: Tensor, *, margin: int) -> DisplacementFields:
    """See ``cleargs.formation.warp.displacement_fields``. ``motion`` [45] is on the CPU."""
    height, width = (side - 2 * margin for side in depth.shape)
    offset, sweep = depth.new_empty(2, height, width), depth.new_empty(2, height, width)
    radius = depth.new_empty(height, width)
    curve = depth.new_empty(4, height, width) if motion[layout.CURVES :].any() else None
    fields = DisplacementFields(offset, sweep, radius, None, curve)
    displace[(_blocks(radius),)](
        depth.contiguous(),
        alpha.contiguous(),
        motion.to(depth.device, non_blocking=True),  # read before the call returns
        *(*_planes(fields), height, width, margin),
        READ_STEPS=layout.READ_STEPS if motion[layout.SKEW].any() else 0,
        CURVED=curve is not None,
        BLOCK=BLOCK,
        num_warps=4,
    )
    return fields


@memory_errors()
def expose(image: Tensor, fields: DisplacementFields, samples: Tensor, *, margin: int) -> Tensor:
    height, width = fields.radius.shape
    light = image.new_empty(height, width, CHANNELS)
    gather_light[(_blocks(fields.radius),)](
        *(image.contiguous(), *_planes(fields), samples, light),
        *(height, width, margin, len(samples), 1.0 / len(samples)),
        TAPS=_taps(samples),
        CURVED=fields.curve is not None,
        BLOCK=BLOCK,
        num_warps=4,
    )
    return light


@memory_errors()
def expose_backward(light: Tensor, fields: DisplacementFields, samples: Tensor, *, margin: int) -> Tensor:
    height, width = fields.radius.shape
    brightest = light.abs().amax().clamp(min=LEAST_LIGHT)
    # The next power of two, so that scaling rounds nothing. It is NaN if the light is not finite.
    bound = brightest / torch.frexp(brightest).mantissa
    bits = SUM_BITS - (height * width - 1).bit_length()
    sums = torch.zeros(
        height + 2 * margin, width + 2 * margin, CHANNELS, dtype=torch.int64, device=light.device
    )
    return_light[(_blocks(fields.radius),)](
        *(light.contiguous(), *_planes(fields), samples, 2.0**bits / len(samples) / bound, sums),
        *(height, width, margin, len(samples)),
        TAPS=_taps(samples),
        CURVED=fields.curve is not None,
        BLOCK=BLOCK,
        num_warps=4,
    )
    return sums.float().mul_(bound * 2.0**-bits)


def _planes(fields: DisplacementFields) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return offset, sweep, radius and curve; for straight paths a tensor that the kernels do not read."""
    curve = fields.offset if fields.curve is None else fields.curve
    return fields.offset, fields.sweep, fields.radius, curve


def _taps(samples: Tensor) -> int:
    """Return the number of pixels between which a sample is interpolated, along one axis."""
    return 4 if len(samples) == 1 else 2


def _blocks(plane: Tensor) -> int:
    return -(-plane.numel() // BLOCK)


@memory_errors()
def through_curve(image: Tensor, curve: Tensor, channels: int) -> tuple[Tensor, Tensor]:
    height, width, stored = image.shape
    out, slope = image.new_empty(height, width, channels), image.new_empty(height, width, 3)
    follow_curve[(_blocks(image[..., 0]),)](
        *(image.contiguous(), curve, out, slope, height * width),
        FROM=stored,
        TO=channels,
        BLOCK=BLOCK,
        num_warps=4,
    )
    return out, slope


def times_slope(light: Tensor, slope: Tensor, channels: int) -> Tensor:
    return torch.nn.functional.pad(light[..., :3] * slope, (0, channels - 3))
