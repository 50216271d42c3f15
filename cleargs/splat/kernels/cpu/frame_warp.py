"""What a camera does to a sharp image while it takes it: blur, rolling shutter and defocus as one warp.

A pixel of the photograph sees the still image at

    x + offset(x) + t sweep(x) + radius(x) (u, v)

for ``samples`` (t, u, v): times t from -1/2 to 1/2 of its exposure, points (u, v) of the unit disc. Fields
are in pixels, [2, H, W] with x before y. The image is larger than the photograph by ``margin`` pixels on
every side; beyond its border the border pixels go on.

Between pixels the image is interpolated by lines, and by cubics where one sample is all (a rolling shutter
without blur): lines would blur what such a frame shows sharp.

Pixels whose samples all lie within the image, nearly all of them, need no care for its border: their path is
the fast one.

A row's arithmetic does not depend on other rows, and the transpose adds up bands of rows of a fixed height in
their order: results do not depend on the number of threads.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import prange

from cleargs.splat.kernels import warp_layout as layout
from cleargs.splat.kernels.cpu.jit import inlined, kernel
from cleargs.splat.kernels.cpu.pixel import (
    black,
    black_pair,
    both,
    fractions_of,
    load_pair,
    load_pixel,
    offset_of,
    place_of,
    shares,
    sum_of,
)
from cleargs.splat.kernels.cpu.simd import store
from cleargs.splat.kernels.warp_layout import CHANNELS
from cleargs.types import AnyArray, ArrayF32

BAND = 32
"""Rows of the photograph whose light one work item of the transpose sends back."""

_ZERO, _ONE = np.float32(0), np.float32(1)
_HALF = np.float32(0.5)


@inlined
def _between(position: Any, last: Any) -> tuple[Any, Any]:  # float32 -> int32, float32
    """The first of the two pixels that ``position`` lies between, and the share of the second."""
    inside = min(max(position, _ZERO), last)
    first = np.int32(min(inside, max(last - _ONE, _ZERO)))
    return first, inside - np.float32(first)


@inlined
def _inside(place: Any, sweep: Any, wide: Any, last: Any) -> Any:  # float32 -> bool
    """Whether all samples of a pixel lie within the image, not near its border; false for NaN.

    A sample's point of the disc may lie a tenth beyond its rim.
    """
    far = _HALF * abs(sweep) + np.float32(1.1) * wide + _ONE
    return place - far >= _ZERO and place + far <= last


@inlined
def _seen_from(start: Any, along: Any, wide: Any, samples: Any, k: Any) -> Any:
    """The place that the ``k``-th sample of a pixel comes from."""
    return start + along * samples[k, 0] + place_of(samples[k, 1], samples[k, 2]) * wide


@inlined
def _cubic(a: Any) -> tuple[Any, Any, Any, Any]:  # float32 -> 4 float32
    """Shares of the four pixels about a place that lies ``a`` behind the second of them.

    Source: Keys, "Cubic convolution interpolation for digital image processing" (1981), with -1/2.
    """
    b = _ONE - a
    outer, inner = -_HALF * a * b, _HALF * a * b
    return outer * b, b + inner * (b + b - a), a + inner * (a + a - b), outer * a


@inlined
def _neighbours(first: Any, count: Any) -> tuple[Any, Any, Any, Any]:  # int32, int64 -> 4 int64
    """Indices of the four pixels about a place behind ``first``; beyond the border those at the border."""
    at, last = np.int64(first), np.int64(count - 1)
    return max(at - 1, 0), at, min(at + 1, last), min(at + 2, last)


@inlined
def _on_curve(curve: Any, value: Any) -> tuple[Any, Any]:  # [STEPS + 1], float32 -> float32, float32
    """The curve at ``value`` and its slope there."""
    steps = np.float32(layout.CURVE_DENSITY)
    place = value * steps
    index = np.int32(min(max(place, _ZERO), np.float32(layout.CURVE_STEPS - 1)))
    rise = curve[index + 1] - curve[index]
    return curve[index] + (place - np.float32(index)) * rise, rise * steps


@kernel
def displacements(
    depth: ArrayF32,  # [H + 2 margin, W + 2 margin] accumulated
    alpha: ArrayF32,  # likewise
    margin: int,
    motion: ArrayF32,  # [25]: see `warp_layout`
    offset: ArrayF32,  # [2, H, W] written
    sweep: ArrayF32,  # [2, H, W] written
    radius: ArrayF32,  # [H, W] written
    reach: AnyArray,  # [H] float64, written: farthest that a pixel of the row looks up or down
) -> None:
    """The fields of a frame's motion and defocus. Nearness is the median depth over the pixel's own.

    Source: Longuet-Higgins & Prazdny, "The interpretation of a moving retinal image" (1980).
    """
    _, height, width = offset.shape
    fx, fy, cx, cy = motion[layout.FX], motion[layout.FY], motion[layout.CX], motion[layout.CY]
    twists = motion[layout.TWISTS :].reshape(3, 6)
    for row in prange(height):
        down = np.float32((row + 0.5) / height - 0.5)
        y = (np.float32(row) + np.float32(0.5) - cy) / fy
        farthest = 0.0
        for column in range(width):
            x = (np.float32(column) + np.float32(0.5) - cx) / fx
            covered = alpha[row + margin, column + margin]
            behind = depth[row + margin, column + margin]
            near = _ONE
            if covered > np.float32(layout.MIN_COVERED) and behind > _ZERO:  # false for NaN
                near = min(motion[layout.MEDIAN] * covered / behind, np.float32(layout.MAX_NEARNESS))
            for part in range(2):
                # Pose and skew displace, blur sweeps.
                tx, ty, tz = twists[part, 0], twists[part, 1], twists[part, 2]
                rx, ry, rz = twists[part, 3], twists[part, 4], twists[part, 5]
                if part == 0:
                    tx, ty, tz = tx + down * twists[2, 0], ty + down * twists[2, 1], tz + down * twists[2, 2]
                    rx, ry, rz = rx + down * twists[2, 3], ry + down * twists[2, 4], rz + down * twists[2, 5]
                along_x = near * (x * tz - tx) + x * y * rx - (_ONE + x * x) * ry + y * rz
                along_y = near * (y * tz - ty) + (_ONE + y * y) * rx - x * y * ry - x * rz
                field = offset if part == 0 else sweep
                field[0, row, column] = along_x
                field[1, row, column] = along_y * (fy / fx)
            radius[row, column] = motion[layout.DISC] * abs(near - motion[layout.FOCUS])
            vertical = abs(offset[1, row, column]) + np.float32(0.5) * abs(sweep[1, row, column])
            farthest = max(farthest, np.float64(vertical + radius[row, column]))
        reach[row] = farthest


@kernel
def apply_curve(image: ArrayF32, curve: ArrayF32, out: ArrayF32, slope: ArrayF32) -> None:
    """The three colours of every pixel through a curve, and the curve's slope there.

    Images are [H, W, 3] or [H, W, 4]; ``slope`` is [H, W, 3].
    """
    height, width, _ = image.shape
    padded = out.shape[2] > 3
    for y in prange(height):
        for x in range(width):
            for c in range(3):
                out[y, x, c], slope[y, x, c] = _on_curve(curve, image[y, x, c])
            if padded:
                out[y, x, 3] = _ZERO


@kernel
def expose(
    image: ArrayF32,  # [H + 2 margin, W + 2 margin, 4] linear light
    margin: int,
    offset: ArrayF32,
    sweep: ArrayF32,
    radius: ArrayF32,
    samples: ArrayF32,  # [K, 3]
    out: ArrayF32,  # [H, W, 4] linear light, written
) -> None:
    """What the sensor gathers of a still image."""
    height, width, _ = out.shape
    rows, columns, _ = image.shape
    right, bottom = np.float32(columns - 1), np.float32(rows - 1)
    beside, below = CHANNELS * min(columns - 1, 1), CHANNELS * columns * min(rows - 1, 1)
    share = _ONE / np.float32(len(samples))
    cubic = len(samples) == 1
    for y in prange(height):
        for x in range(width):
            x0 = np.float32(x + margin) + offset[0, y, x]
            y0 = np.float32(y + margin) + offset[1, y, x]
            along_x, along_y, wide = sweep[0, y, x], sweep[1, y, x], radius[y, x]
            if not cubic and _inside(x0, along_x, wide, right) and _inside(y0, along_y, wide, bottom):
                start, along = place_of(x0, y0), place_of(along_x, along_y)
                sums = black_pair()
                for k in range(len(samples)):
                    place = _seen_from(start, along, wide, samples, k)
                    a, b = fractions_of(place)
                    at = offset_of(place, columns)
                    above, under = load_pair(image, at), load_pair(image, at + below)
                    sums = sums + (above * (_ONE - b) + under * b) * shares(a)
                store(out, CHANNELS * (y * width + x), sum_of(sums) * share)
                continue
            total = black()
            for k in range(len(samples)):
                i, a = _between(x0 + samples[k, 0] * along_x + samples[k, 1] * wide, right)
                j, b = _between(y0 + samples[k, 0] * along_y + samples[k, 2] * wide, bottom)
                if cubic:
                    across, weights = _neighbours(i, columns), _cubic(a)
                    down, parts = _neighbours(j, rows), _cubic(b)
                    for m in range(4):
                        for n in range(4):
                            at = CHANNELS * (down[m] * columns + across[n])
                            total = total + load_pixel(image, at) * (parts[m] * weights[n])
                    continue
                at = CHANNELS * (np.int64(j) * columns + i)
                total = total + load_pixel(image, at) * ((_ONE - b) * (_ONE - a))
                total = total + load_pixel(image, at + beside) * ((_ONE - b) * a)
                total = total + load_pixel(image, at + below) * (b * (_ONE - a))
                total = total + load_pixel(image, at + below + beside) * (b * a)
            store(out, CHANNELS * (y * width + x), total * share)


@kernel
def spread(
    light: ArrayF32,  # [H, W, 4]
    margin: int,
    reach: int,
    offset: ArrayF32,
    sweep: ArrayF32,
    radius: ArrayF32,
    samples: ArrayF32,  # [K, 3]
    bands: ArrayF32,  # [bands, BAND + 2 reach, W + 2 margin, 4], written
    rows: int,
) -> None:
    """The transpose of `expose`, before `gather`: what every pixel saw goes back to where it came from.

    ``rows`` are those of the image; no pixel looks up or down by more than ``reach`` - 3 pixels.
    """
    height, width, _ = light.shape
    columns = bands.shape[2]
    right, bottom = np.float32(columns - 1), np.float32(rows - 1)
    beside, below = CHANNELS * min(columns - 1, 1), CHANNELS * columns * min(rows - 1, 1)
    share = _ONE / np.float32(len(samples))
    cubic = len(samples) == 1
    for band in prange(len(bands)):
        part = bands[band]
        part[:] = _ZERO
        first = band * BAND + margin - reach
        for y in range(band * BAND, min((band + 1) * BAND, height)):
            for x in range(width):
                seen = load_pixel(light, CHANNELS * (y * width + x)) * share
                x0 = np.float32(x + margin) + offset[0, y, x]
                y0 = np.float32(y + margin) + offset[1, y, x]
                along_x, along_y, wide = sweep[0, y, x], sweep[1, y, x], radius[y, x]
                if not cubic and _inside(x0, along_x, wide, right) and _inside(y0, along_y, wide, bottom):
                    start, along = place_of(x0, y0), place_of(along_x, along_y)
                    twice = both(seen)
                    for k in range(len(samples)):
                        place = _seen_from(start, along, wide, samples, k)
                        a, b = fractions_of(place)
                        at = offset_of(place, columns) - CHANNELS * first * columns
                        across = shares(a)
                        store(part, at, load_pair(part, at) + twice * (across * (_ONE - b)))
                        store(part, at + below, load_pair(part, at + below) + twice * (across * b))
                    continue
                for k in range(len(samples)):
                    i, a = _between(x0 + samples[k, 0] * along_x + samples[k, 1] * wide, right)
                    j, b = _between(y0 + samples[k, 0] * along_y + samples[k, 2] * wide, bottom)
                    if cubic:
                        across, weights = _neighbours(i, columns), _cubic(a)
                        down, parts = _neighbours(j, rows), _cubic(b)
                        for m in range(4):
                            for n in range(4):
                                at = CHANNELS * ((down[m] - first) * columns + across[n])
                                _add(part, at, seen, parts[m] * weights[n])
                        continue
                    at = CHANNELS * (np.int64(j - first) * columns + i)
                    _add(part, at, seen, (_ONE - b) * (_ONE - a))
                    _add(part, at + beside, seen, (_ONE - b) * a)
                    _add(part, at + below, seen, b * (_ONE - a))
                    _add(part, at + below + beside, seen, b * a)


@inlined
def _add(image: Any, offset: Any, light: Any, share: Any) -> None:
    store(image, offset, load_pixel(image, offset) + light * share)


@kernel
def gather(bands: ArrayF32, margin: int, reach: int, out: ArrayF32) -> None:
    """The sum of the bands in their order, [H + 2 margin, W + 2 margin, 4]."""
    height, width, _ = out.shape
    for y in prange(height):
        out[y] = _ZERO
        for band in range(len(bands)):
            row = y - (band * BAND + margin - reach)
            if 0 <= row < bands.shape[1]:
                for x in range(width):
                    for c in range(CHANNELS):
                        out[y, x, c] += bands[band, row, x, c]


@kernel
def multiply(light: ArrayF32, slope: ArrayF32, out: ArrayF32) -> None:
    """light * slope for three colours: ``slope`` is [H, W, 3], the others have three channels or four."""
    height, width, _ = slope.shape
    padded = out.shape[2] > 3
    for y in prange(height):
        for x in range(width):
            for c in range(3):
                out[y, x, c] = light[y, x, c] * slope[y, x, c]
            if padded:
                out[y, x, 3] = _ZERO


@kernel
def misfits(
    image: ArrayF32,  # [H, W]
    observed: ArrayF32,  # [H, W]
    weight: ArrayF32,  # [H, W]
    offset: ArrayF32,
    sweep: ArrayF32,
    radius: ArrayF32,
    samples: ArrayF32,  # [K, 3]
    limit: float,
    rows: AnyArray,  # [H] float64, written
) -> None:
    """Each row's sum of weight * min(|observed - photographed image|, limit); images without a margin.

    Pixels of no weight are not looked at.
    """
    height, width = image.shape
    right, bottom = np.float32(width - 1), np.float32(height - 1)
    share = _ONE / np.float32(len(samples))
    for y in prange(height):
        # Those that count, side by side, so that the inner loop can be vectorised.
        place, along = np.empty((2, width), np.float32), np.empty((2, width), np.float32)
        wide, exposed = np.empty(width, np.float32), np.zeros(width, np.float32)
        count = 0
        for x in range(width):
            if weight[y, x] != 0.0:
                place[0, count] = np.float32(x) + offset[0, y, x]
                place[1, count] = np.float32(y) + offset[1, y, x]
                along[0, count], along[1, count] = sweep[0, y, x], sweep[1, y, x]
                wide[count] = radius[y, x]
                count += 1
        for k in range(len(samples)):
            for n in range(count):
                i, a = _between(place[0, n] + samples[k, 0] * along[0, n] + samples[k, 1] * wide[n], right)
                j, b = _between(place[1, n] + samples[k, 0] * along[1, n] + samples[k, 2] * wide[n], bottom)
                above = image[j, i] + a * (image[j, i + 1] - image[j, i])
                below = image[j + 1, i] + a * (image[j + 1, i + 1] - image[j + 1, i])
                exposed[n] += above + b * (below - above)
        total, count = 0.0, 0
        for x in range(width):
            if weight[y, x] != 0.0:
                total += weight[y, x] * min(abs(observed[y, x] - exposed[count] * share), limit)
                count += 1
        rows[y] = total


@kernel
def normal_equations(
    stack: ArrayF32,  # [H, W, 3]: image, its derivatives by x and y
    observed: ArrayF32,  # [H, W]
    weight: ArrayF32,  # [H, W]
    basis: ArrayF32,  # [6, 2, H, W]: flow by each component of a twist
    down: ArrayF32,  # [H]: -1/2 at the first row of the photograph, 1/2 at its last
    offset: ArrayF32,
    sweep: ArrayF32,
    times: ArrayF32,  # [K]
    outlier: float,
    active: AnyArray,  # [A] int64: which of the 18 numbers of pose, blur and skew are sought
    matrices: AnyArray,  # [H, A, A] float64, written (lower triangles)
    sides: AnyArray,  # [H, A] float64, written
) -> None:
    """Each row's share of the Gauss-Newton equations of the twists of pose, blur and skew.

    Differences beyond ``outlier`` count linearly (Huber's weights).
    """
    height, width = observed.shape
    right, bottom = np.float32(width - 1), np.float32(height - 1)
    share = 1.0 / times.size
    twist = basis.shape[0]
    for y in prange(height):
        matrices[y] = 0.0
        sides[y] = 0.0
        jacobian = np.empty(3 * twist)
        means = np.empty(5, np.float32)
        for x in range(width):
            if weight[y, x] == 0.0:
                continue
            means[:] = 0.0
            for t in times:
                i, a = _between(np.float32(x) + offset[0, y, x] + t * sweep[0, y, x], right)
                j, b = _between(np.float32(y) + offset[1, y, x] + t * sweep[1, y, x], bottom)
                for c in range(3):
                    above = stack[j, i, c] + a * (stack[j, i + 1, c] - stack[j, i, c])
                    below = stack[j + 1, i, c] + a * (stack[j + 1, i + 1, c] - stack[j + 1, i, c])
                    value = above + b * (below - above)
                    means[c] += value
                    if c > 0:
                        means[c + 2] += t * value
            for n in range(twist):
                u, v = share * basis[n, 0, y, x], share * basis[n, 1, y, x]
                moved = u * means[1] + v * means[2]
                jacobian[n] = moved
                jacobian[twist + n] = u * means[3] + v * means[4]
                jacobian[2 * twist + n] = down[y] * moved
            left = observed[y, x] - share * means[0]
            factor = weight[y, x] / max(1.0, abs(left) / outlier)
            for n in range(len(active)):
                scaled = factor * jacobian[active[n]]
                sides[y, n] += scaled * left
                for m in range(n + 1):
                    matrices[y, n, m] += scaled * jacobian[active[m]]
