"""Warp a sharp image as a moving camera records it: blur, rolling shutter and defocus in one operation.

A pixel x of the formed image is the mean of the sharp image at

    x + offset(x) + t sweep(x) + (t^2 - 1/12) bend(x) + (t^3 - 3t/20) cube(x) + radius(x) (u, v)

over ``samples`` (t, u, v): times t from -1/2 to 1/2 of the exposure, and points (u, v) of the unit disc. The
polynomials are orthogonal over the exposure. ``curve`` [4, H, W] holds bend and cube. It is None for straight
paths; Numba then compiles the kernels without these terms. Fields are in pixels, [2, H, W] with x before y.
The sharp image is larger than the formed image by ``margin`` pixels on every side. Beyond its border, the
border pixels are repeated.

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
"""Rows of the formed image per work item of the transpose."""

_ZERO, _ONE = np.float32(0), np.float32(1)
_HALF = np.float32(0.5)


@inlined
def between(position: Any, last: Any) -> tuple[Any, Any]:  # float32 -> int32, float32
    """Return the first of the two pixels around ``position``, and the weight of the second."""
    inside = min(max(position, _ZERO), last)
    first = np.int32(min(inside, max(last - _ONE, _ZERO)))
    return first, inside - np.float32(first)


@inlined
def second_order(t: Any) -> Any:
    """Return the polynomial of second order at time ``t`` of the exposure, from -1/2 to 1/2."""
    return t * t - np.float32(1.0 / 12.0)


@inlined
def third_order(t: Any) -> Any:
    """Return the polynomial of third order at time ``t`` of the exposure."""
    return t * (t * t - np.float32(3.0 / 20.0))


@inlined
def deviation(t: Any, bend: Any, cube: Any) -> Any:
    """Return the displacement from the straight path at time ``t`` of the exposure, along one axis."""
    return second_order(t) * bend + third_order(t) * cube


@inlined
def _curved_reach(bend: Any, cube: Any) -> Any:  # float32 -> float32
    """Return an upper bound of the distance between the curved and the straight path along an axis, px."""
    return np.float32(layout.BEND_REACH) * abs(bend) + np.float32(layout.CUBE_REACH) * abs(cube)


@inlined
def _path(
    x: Any, y: Any, margin: Any, offset: Any, sweep: Any, radius: Any, curve: Any
) -> tuple[Any, Any, Any, Any]:
    """Return the path of a pixel along x, along y, along both (as pixels of `place_of`), and its disc radius.

    A path is a tuple: the mean place in the sharp image, the sweep, the bend and the cube, in px.
    """
    x0 = np.float32(x + margin) + offset[0, y, x]
    y0 = np.float32(y + margin) + offset[1, y, x]
    bend_x, bend_y, cube_x, cube_y = _ZERO, _ZERO, _ZERO, _ZERO
    if curve is not None:
        bend_x, bend_y, cube_x, cube_y = curve[0, y, x], curve[1, y, x], curve[2, y, x], curve[3, y, x]
    across = x0, sweep[0, y, x], bend_x, cube_x
    down = y0, sweep[1, y, x], bend_y, cube_y
    start, along = place_of(x0, y0), place_of(across[1], down[1])
    return across, down, (start, along, place_of(bend_x, bend_y), place_of(cube_x, cube_y)), radius[y, x]


@inlined
def _inside(path: Any, wide: Any, last: Any) -> Any:  # 4 float32, float32, float32 -> bool
    """Return True if all samples of a pixel are inside the image and not near its border; False for NaN.

    The point of a sample may be outside the unit disc by up to a tenth of its radius.
    """
    place, sweep, bend, cube = path
    far = _HALF * abs(sweep) + np.float32(1.1) * wide + _ONE + _curved_reach(bend, cube)
    return place - far >= _ZERO and place + far <= last


@inlined
def _place_at(path: Any, disc: Any, t: Any, curve: Any) -> Any:
    """Return the position in the sharp image of a sample at time ``t``, offset from the path by ``disc``."""
    place, sweep, bend, cube = path
    place = place + sweep * t + disc
    return place if curve is None else place + bend * second_order(t) + cube * third_order(t)


@inlined
def _along_axis(path: Any, disc: Any, t: Any, curve: Any) -> Any:
    """Return one coordinate of the position of `_place_at`, for a path along one axis."""
    place, sweep, bend, cube = path
    place = place + t * sweep + disc
    return place if curve is None else place + deviation(t, bend, cube)


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


@inlined
def _twist(twists: Any, k: Any) -> Any:  # [5, 6] -> 6 float32
    return twists[k, 0], twists[k, 1], twists[k, 2], twists[k, 3], twists[k, 4], twists[k, 5]


@inlined
def _flow(x: Any, y: Any, near: Any, twist: Any) -> tuple[Any, Any]:
    """Return the displacement of a pixel on the ray (x, y, 1) under a twist [6], px if fy is equal to fx."""
    tx, ty, tz, rx, ry, rz = twist
    along_x = near * (x * tz - tx) + x * y * rx - (_ONE + x * x) * ry + y * rz
    along_y = near * (y * tz - ty) + (_ONE + y * y) * rx - x * y * ry - x * rz
    return along_x, along_y


@inlined
def _nearness(depth: Any, alpha: Any, row: Any, column: Any, median: Any) -> Any:
    """Return the median depth over the depth of a pixel; 1 where it has none."""
    # Without branches, so that loops over pixels are vectorised.
    covered, behind = alpha[row, column], depth[row, column]
    seen = (covered > np.float32(layout.MIN_COVERED)) & (behind > _ZERO)  # false for NaN
    near = median * covered / behind
    near = near if near < np.float32(layout.MAX_NEARNESS) else np.float32(layout.MAX_NEARNESS)
    return near if seen else _ONE


@inlined
def _read_flow(row: Any, column: Any, x: Any, y: Any, depth: Any, alpha: Any, sizes: Any, twist: Any) -> Any:
    """Return the displacement, px, of a pixel (``row``, ``column`` of ``depth``) under a long ``twist``.

    It is the second-order solution (midpoint rule) of the motion along the path, with the nearness of the
    point that the pixel sees. ``sizes`` are fx, fy over fx, and the median depth.
    """
    rows, columns = depth.shape
    fx, ratio, median = sizes
    along_x, along_y = _flow(x, y, _nearness(depth, alpha, row, column, median), twist)
    half = _HALF / fx
    for _ in range(layout.READ_STEPS):
        down = min(max(np.float32(row) + along_y * ratio + _HALF, _ZERO), np.float32(rows - 1))
        across = min(max(np.float32(column) + along_x + _HALF, _ZERO), np.float32(columns - 1))
        near = _nearness(depth, alpha, np.int64(down), np.int64(across), median)
        along_x, along_y = _flow(x + half * along_x, y + half * along_y, near, twist)
    return along_x, along_y * ratio


@kernel
def read_displacements(
    depth: ArrayF32,  # [H, W] accumulated
    alpha: ArrayF32,  # [H, W]
    lens: ArrayF32,  # the first numbers of a motion: see `warp_layout`
    twists: ArrayF32,  # [3, 6] pose, skew, skew_bend
    down: ArrayF32,  # [H] places of the rows within the readout, -1/2 to 1/2; zeros if columns are read
    across: ArrayF32,  # [W] likewise of the columns
    offset: ArrayF32,  # [2, H, W] written
) -> None:
    """Compute the displacements, px, of all pixels by the readout alone."""
    height, width = depth.shape
    for row in prange(height):
        # Numbers instead of arrays, so that the loop over the pixels is vectorised.
        fx, fy, cx = lens[layout.FX], lens[layout.FY], lens[layout.CX]
        sizes = fx, fy / fx, lens[layout.MEDIAN]
        pose, skew, skew_bend = _twist(twists, 0), _twist(twists, 1), _twist(twists, 2)
        y = (np.float32(row) + _HALF - lens[layout.CY]) / fy
        read_down = down[row]
        for column in range(width):
            x = (np.float32(column) + _HALF - cx) / fx
            twist = _at_readout(pose, skew, skew_bend, read_down + across[column])
            along_x, along_y = _read_flow(row, column, x, y, depth, alpha, sizes, twist)
            offset[0, row, column] = along_x
            offset[1, row, column] = along_y


@inlined
def _at_readout(pose: Any, skew: Any, skew_bend: Any, read: Any) -> Any:  # [6] each -> 6 float32
    """Return the twist of a pixel that is read at ``read``, from -1/2 to 1/2."""
    again = read * read
    return (
        pose[0] + read * skew[0] + again * skew_bend[0],
        pose[1] + read * skew[1] + again * skew_bend[1],
        pose[2] + read * skew[2] + again * skew_bend[2],
        pose[3] + read * skew[3] + again * skew_bend[3],
        pose[4] + read * skew[4] + again * skew_bend[4],
        pose[5] + read * skew[5] + again * skew_bend[5],
    )


@inlined
def _write_flow(
    out: Any, part: Any, row: Any, nearness: Any, y: Any, fx: Any, cx: Any, ratio: Any, twist: Any
) -> None:
    """Write the displacements of a row under ``twist`` to the planes ``part`` and ``part + 1`` of ``out``."""
    for column in range(len(nearness)):
        x = (np.float32(column) + _HALF - cx) / fx
        along_x, along_y = _flow(x, y, nearness[column], twist)
        out[part, row, column] = along_x
        out[part + 1, row, column] = along_y * ratio


@kernel
def displacements(
    depth: ArrayF32,  # [H + 2 margin, W + 2 margin] accumulated
    alpha: ArrayF32,  # [H + 2 margin, W + 2 margin]
    margin: int,
    motion: ArrayF32,  # [45]: see `warp_layout`
    offset: ArrayF32,  # [2, H, W] written
    sweep: ArrayF32,  # [2, H, W] written
    radius: ArrayF32,  # [H, W] written
    curve: ArrayF32 | None,  # [4, H, W] written
    reach: AnyArray,  # [H] float64, written: largest vertical displacement of a sample per row, px
) -> None:
    """Compute the displacement fields of a frame's motion and defocus.

    Translations and defocus depend on the nearness of a pixel: the median depth divided by its depth.

    Source: Longuet-Higgins & Prazdny, "The interpretation of a moving retinal image" (1980).
    """
    _, height, width = offset.shape
    fx, fy, cx, cy = motion[layout.FX], motion[layout.FY], motion[layout.CX], motion[layout.CY]
    twists = motion[layout.TWISTS :].reshape(6, 6)
    rolls = np.any(motion[layout.SKEW] != _ZERO)
    for row in prange(height):
        # Numbers instead of arrays, and a loop for each field, so that the loops are vectorised.
        median, disc, focus = motion[layout.MEDIAN], motion[layout.DISC], motion[layout.FOCUS]
        ratio = fy / fx
        sizes = fx, ratio, median
        pose, blur = _twist(twists, 0), _twist(twists, 1)
        skew, skew_bend = _twist(twists, 2), _twist(twists, 3)
        bend, cube = _twist(twists, 4), _twist(twists, 5)
        read_across = motion[layout.READ_ACROSS]
        down = motion[layout.READ_DOWN] * np.float32((row + 0.5) / height - 0.5)
        y = (np.float32(row) + _HALF - cy) / fy
        nearness = np.empty(width, np.float32)
        for column in range(width):
            nearness[column] = _nearness(depth, alpha, row + margin, column + margin, median)
        if rolls:
            for column in range(width):
                x = (np.float32(column) + _HALF - cx) / fx
                read = down + read_across * np.float32((column + 0.5) / width - 0.5)
                moved = _at_readout(pose, skew, skew_bend, read)
                along_x, along_y = _read_flow(row + margin, column + margin, x, y, depth, alpha, sizes, moved)
                offset[0, row, column] = along_x
                offset[1, row, column] = along_y
        else:
            _write_flow(offset, 0, row, nearness, y, fx, cx, ratio, pose)
        _write_flow(sweep, 0, row, nearness, y, fx, cx, ratio, blur)
        for column in range(width):
            radius[row, column] = disc * abs(nearness[column] - focus)
        if curve is not None:
            _write_flow(curve, 0, row, nearness, y, fx, cx, ratio, bend)
            _write_flow(curve, 2, row, nearness, y, fx, cx, ratio, cube)
        farthest = 0.0
        for column in range(width):
            vertical = abs(offset[1, row, column]) + np.float32(0.5) * abs(sweep[1, row, column])
            if curve is not None:
                vertical += _curved_reach(curve[1, row, column], curve[3, row, column])
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
    curve: ArrayF32 | None,  # [4, H, W]
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
            across, down, path, wide = _path(x, y, margin, offset, sweep, radius, curve)
            if _inside(across, wide, right) and _inside(down, wide, bottom) and not cubic:
                sums = black_pair()
                for k in range(len(samples)):
                    disc = place_of(samples[k, 1], samples[k, 2]) * wide
                    place = _place_at(path, disc, samples[k, 0], curve)
                    a, b = fractions_of(place)
                    at = offset_of(place, columns)
                    above, under = load_pair(image, at), load_pair(image, at + next_row)
                    sums = sums + (above * (_ONE - b) + under * b) * shares(a)
                store(out, CHANNELS * (y * width + x), sum_of(sums) * share)
                continue
            total = black()
            for k in range(len(samples)):
                i, a = between(_along_axis(across, samples[k, 1] * wide, samples[k, 0], curve), right)
                j, b = between(_along_axis(down, samples[k, 2] * wide, samples[k, 0], curve), bottom)
                if cubic:
                    near_x, weights = _neighbours(i, columns), _cubic(a)
                    near_y, parts = _neighbours(j, rows), _cubic(b)
                    for m in range(4):
                        for n in range(4):
                            at = CHANNELS * (near_y[m] * columns + near_x[n])
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
    curve: ArrayF32 | None,  # [4, H, W]
    samples: ArrayF32,  # [K, 3] t, u, v
    bands: ArrayF32,  # [bands, BAND + 2 reach, W + 2 margin, 4], written
    rows: int,
) -> None:
    """Add the light of every observed pixel to the pixels that it sampled, one band of rows per work item.

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
                across, down, path, wide = _path(x, y, margin, offset, sweep, radius, curve)
                if _inside(across, wide, right) and _inside(down, wide, bottom) and not cubic:
                    twice = both(seen)
                    for k in range(len(samples)):
                        disc = place_of(samples[k, 1], samples[k, 2]) * wide
                        place = _place_at(path, disc, samples[k, 0], curve)
                        a, b = fractions_of(place)
                        at = offset_of(place, columns) - CHANNELS * first * columns
                        sides = shares(a)
                        store(part, at, load_pair(part, at) + twice * (sides * (_ONE - b)))
                        store(part, at + next_row, load_pair(part, at + next_row) + twice * (sides * b))
                    continue
                for k in range(len(samples)):
                    i, a = between(_along_axis(across, samples[k, 1] * wide, samples[k, 0], curve), right)
                    j, b = between(_along_axis(down, samples[k, 2] * wide, samples[k, 0], curve), bottom)
                    if cubic:
                        near_x, weights = _neighbours(i, columns), _cubic(a)
                        near_y, parts = _neighbours(j, rows), _cubic(b)
                        for m in range(4):
                            for n in range(4):
                                at = CHANNELS * ((near_y[m] - first) * columns + near_x[n])
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
