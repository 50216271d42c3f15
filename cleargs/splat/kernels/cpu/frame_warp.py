"""Warp a sharp image as a moving camera records it: blur, rolling shutter and defocus in one operation.

A pixel x of the observed image is the mean of the sharp image at

    x + offset(x) + t sweep(x) + radius(x) (u, v)

over ``samples`` (t, u, v): times t from -1/2 to 1/2 of the exposure, and points (u, v) of the unit disc.
Fields are in pixels, [2, H, W] with x before y. The sharp image is larger than the observed image by
``margin`` pixels on every side. Beyond its border, the border pixels are repeated.

Interpolation between pixels is linear. With a single sample (a rolling shutter without blur) it is cubic,
because linear interpolation would blur a sharp frame.

Almost all pixels have all their samples inside the image. They take a fast path without border checks.

The arithmetic of a row does not depend on other rows, and the transpose adds bands of a fixed height in their
order. Results therefore do not depend on the number of threads.
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
"""Rows of the observed image per work item of the transpose."""

_ZERO, _ONE = np.float32(0), np.float32(1)
_HALF = np.float32(0.5)


@inlined
def _between(position: Any, last: Any) -> tuple[Any, Any]:  # float32 -> int32, float32
    """Return the first of the two pixels around ``position``, and the weight of the second."""
    inside = min(max(position, _ZERO), last)
    first = np.int32(min(inside, max(last - _ONE, _ZERO)))
    return first, inside - np.float32(first)


@inlined
def _inside(place: Any, sweep: Any, wide: Any, last: Any) -> Any:  # float32 -> bool
    """Return True if all samples of a pixel are inside the image and not near its border; False for NaN.

    The point of a sample may be outside the unit disc by up to a tenth of its radius.
    """
    far = _HALF * abs(sweep) + np.float32(1.1) * wide + _ONE
    return place - far >= _ZERO and place + far <= last


@inlined
def _seen_from(start: Any, along: Any, wide: Any, samples: Any, k: Any) -> Any:
    """Return the position in the sharp image of the ``k``-th sample of a pixel."""
    return start + along * samples[k, 0] + place_of(samples[k, 1], samples[k, 2]) * wide


@inlined
def _cubic(a: Any) -> tuple[Any, Any, Any, Any]:  # float32 -> 4 float32
    """Return the weights of the four pixels around a position, which is ``a`` pixels after the second.

    Source: Keys, "Cubic convolution interpolation for digital image processing" (1981), parameter -1/2.
    """
    b = _ONE - a
    outer, inner = -_HALF * a * b, _HALF * a * b
    return outer * b, b + inner * (b + b - a), a + inner * (a + a - b), outer * a


@inlined
def _neighbours(first: Any, count: Any) -> tuple[Any, Any, Any, Any]:  # int32, int64 -> 4 int64
    """Return the indices of the four pixels around a position after ``first``, clamped to the image."""
    at, last = np.int64(first), np.int64(count - 1)
    return max(at - 1, 0), at, min(at + 1, last), min(at + 2, last)


@inlined
def _on_curve(curve: Any, value: Any) -> tuple[Any, Any]:  # [STEPS + 1], float32 -> float32, float32
    """Return the curve and its slope at ``value``."""
    steps = np.float32(layout.CURVE_DENSITY)
    place = value * steps
    index = np.int32(min(max(place, _ZERO), np.float32(layout.CURVE_STEPS - 1)))
    rise = curve[index + 1] - curve[index]
    return curve[index] + (place - np.float32(index)) * rise, rise * steps


@kernel
def displacements(
    depth: ArrayF32,  # [H + 2 margin, W + 2 margin] accumulated
    alpha: ArrayF32,  # [H + 2 margin, W + 2 margin]
    margin: int,
    motion: ArrayF32,  # [25]: see `warp_layout`
    offset: ArrayF32,  # [2, H, W] written
    sweep: ArrayF32,  # [2, H, W] written
    radius: ArrayF32,  # [H, W] written
    reach: AnyArray,  # [H] float64, written: largest vertical displacement of a sample per row, px
) -> None:
    """Compute the displacement fields of a frame's motion and defocus.

    Translations and defocus depend on the nearness of a pixel: the median depth divided by its depth.

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
                # Pose and skew give the offset, blur gives the sweep.
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
    """Apply a curve to the three colours of every pixel, and write the curve's slopes there.

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
    offset: ArrayF32,  # [2, H, W]
    sweep: ArrayF32,  # [2, H, W]
    radius: ArrayF32,  # [H, W]
    samples: ArrayF32,  # [K, 3] t, u, v
    out: ArrayF32,  # [H, W, 4] linear light, written
) -> None:
    """Compute the light that each pixel of the sensor collects from a sharp image."""
    height, width, _ = out.shape
    rows, columns, _ = image.shape
    right, bottom = np.float32(columns - 1), np.float32(rows - 1)
    next_column, next_row = CHANNELS * min(columns - 1, 1), CHANNELS * columns * min(rows - 1, 1)
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
                    above, under = load_pair(image, at), load_pair(image, at + next_row)
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
                total = total + load_pixel(image, at + next_column) * ((_ONE - b) * a)
                total = total + load_pixel(image, at + next_row) * (b * (_ONE - a))
                total = total + load_pixel(image, at + next_row + next_column) * (b * a)
            store(out, CHANNELS * (y * width + x), total * share)


@kernel
def spread(
    light: ArrayF32,  # [H, W, 4]
    margin: int,
    reach: int,
    offset: ArrayF32,  # [2, H, W]
    sweep: ArrayF32,  # [2, H, W]
    radius: ArrayF32,  # [H, W]
    samples: ArrayF32,  # [K, 3] t, u, v
    bands: ArrayF32,  # [bands, BAND + 2 reach, W + 2 margin, 4], written
    rows: int,
) -> None:
    """Add the light of every observed pixel to the pixels that it sampled, one band per work item.

    With `gather`, this is the transpose of `expose`. ``rows`` is the height of the sharp image. No vertical
    displacement is above ``reach`` - 3 pixels.
    """
    height, width, _ = light.shape
    columns = bands.shape[2]
    right, bottom = np.float32(columns - 1), np.float32(rows - 1)
    next_column, next_row = CHANNELS * min(columns - 1, 1), CHANNELS * columns * min(rows - 1, 1)
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
                        store(part, at + next_row, load_pair(part, at + next_row) + twice * (across * b))
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
                    _add(part, at + next_column, seen, (_ONE - b) * a)
                    _add(part, at + next_row, seen, b * (_ONE - a))
                    _add(part, at + next_row + next_column, seen, b * a)


@inlined
def _add(image: Any, offset: Any, light: Any, share: Any) -> None:
    store(image, offset, load_pixel(image, offset) + light * share)


@kernel
def gather(bands: ArrayF32, margin: int, reach: int, out: ArrayF32) -> None:
    """Add the bands in their order into an image [H + 2 margin, W + 2 margin, 4]."""
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
    """Multiply three colours by ``slope`` [H, W, 3]; the images have three or four channels."""
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
    offset: ArrayF32,  # [2, H, W]
    sweep: ArrayF32,  # [2, H, W]
    radius: ArrayF32,  # [H, W]
    samples: ArrayF32,  # [K, 3] t, u, v
    limit: float,
    rows: AnyArray,  # [H] float64, written
) -> None:
    """Write each row's sum of weight * min(|observed - warped image|, limit); images have no margin.

    Pixels with weight 0 are skipped.
    """
    height, width = image.shape
    right, bottom = np.float32(width - 1), np.float32(height - 1)
    share = _ONE / np.float32(len(samples))
    for y in prange(height):
        # Pixels that count are packed without gaps, so that the inner loop can be vectorised.
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
    basis: ArrayF32,  # [6, 2, H, W]: image motion per component of a twist, px
    down: ArrayF32,  # [H]: -1/2 at the first row of the frame, 1/2 at its last
    offset: ArrayF32,  # [2, H, W]
    sweep: ArrayF32,  # [2, H, W]
    times: ArrayF32,  # [K]
    outlier: float,
    active: AnyArray,  # [A] int64: unknowns, of the 18 numbers of pose, blur and skew
    matrices: AnyArray,  # [H, A, A] float64, written (lower triangles)
    sides: AnyArray,  # [H, A] float64, written
) -> None:
    """Write each row's share of the Gauss-Newton equations for the twists of pose, blur and skew.

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
