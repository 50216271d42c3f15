"""Tile rasterisation, forward and backward.

Per pixel, over the tile's splats from near to far, with T the transmittance so far (T = 1 at first):

    alpha = min(2^(log2 alpha), 0.999), skipped below 1/255
    stop for good where T (1 - alpha) < 1e-4
    colour += alpha T c,   depth += alpha T z,   T *= 1 - alpha

and in the end image = colour + T background. Backward, from far to near, with g = dL/d(pixel), w = alpha T
and S the part of g · pixel that lies behind the splat,

    v = dL/d(ln alpha) = w (g · c) - S alpha / (1 - alpha),   0 where alpha is clamped.

Only the sums of v times 1, u, dy, u², u dy, dy² and of w g are needed of a (tile, splat) pair
(layout.SUM_*); gradients.backpropagate turns them into gradients once per Gaussian. Each pair owns a row
of scratch, so there are no atomics, no races and no dependence on the number of threads.

A tile's pixels live in a small buffer in "half-major" order: vector j = 16 h + r is row r of the tile's
half h, eight pixels wide. Only the vectors that the ellipse touches are visited, found for all 32 at once.
Depth is an optional fourth channel: the array is None where it is not wanted, and Numba drops the code.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import prange

from cleargs.splat import constants
from cleargs.splat.kernels.cpu.jit import Array, Floats, device, inlined, kernel
from cleargs.splat.kernels.cpu.layout import (
    BEND_X,
    BEND_Y,
    BLUE,
    DEPTH,
    GREEN,
    LOG2_OPACITY,
    MEAN_X,
    MEAN_Y,
    PIECES,
    RED,
    SKEW,
    SUM_BLUE,
    SUM_DEPTH,
    TILE,
    TILE_PIXELS,
)
from cleargs.splat.kernels.cpu.simd import (
    LANES,
    any8,
    broadcast8,
    lane_numbers,
    lane_sum,
    lane_sums,
    load8,
    lowest_bit,
    mask_bits,
    max8,
    min8,
    negative_magnitude8,
    select8,
    store8,
)

ZERO, ONE, HALF, SEVEN, EIGHT = (np.float32(x) for x in (0, 1, 0.5, 7, 8))
ALPHA_MAX = np.float32(constants.ALPHA_MAX)
ALPHA_CUT = np.float32(constants.ALPHA_CUT)
TRANSMITTANCE_STOP = np.float32(constants.TRANSMITTANCE_STOP)
TOUCH_CUT = np.float32(constants.LOG2_ALPHA_CUT - 2e-3)
"""log2(alpha) from which a row piece is visited; the decision itself is made per pixel."""

ALIVE_INTERVAL = 16
"""After this many splats the vectors whose pixels are all finished are taken off the list."""

# Geometry of the splat at hand, behind the pixel buffers: one value per tile row or column.
ROW_LOG2 = 0  # log2 alpha on the ridge of each row, [16]
ROW_RIDGE = 16  # dx of the ridge of each row, [16]
ROW_DY = 32  # dy of each row, [16]
COLUMN_DX = 48  # dx of each column, [16]
GEOMETRY_SIZE = 64

# Pixel buffers of the forward pass. The sign of T marks finished pixels (and those outside the image).
T_FORWARD = 0
LAST_FORWARD = 256  # number, from 1, of the last splat that contributed; exact up to 2^24 splats a tile
RED_FORWARD = 512
GREEN_FORWARD = 768
BLUE_FORWARD = 1024
DEPTH_FORWARD = 1280
GEOMETRY_FORWARD = 1536
FORWARD_SIZE = GEOMETRY_FORWARD + GEOMETRY_SIZE

# Pixel buffers of the backward pass.
T_BACKWARD = 0
LAST_BACKWARD = 256
BEHIND = 512  # S
GRAD_RED = 768
GRAD_GREEN = 1024
GRAD_BLUE = 1280
GRAD_DEPTH = 1536
LAST_OF_PIECE = 1792  # the largest LAST of each vector, [32]
GEOMETRY_BACKWARD = 1824
BACKWARD_SIZE = GEOMETRY_BACKWARD + GEOMETRY_SIZE

ALL_PIECES = np.int64(2**PIECES - 1)


def _exp2_coefficients() -> tuple[np.float32, ...]:
    """Polynomial p of degree 5 with p(t)^8 = 2^t on [-9, 0.16].

    Fitted to 2^(t/8) by least squares of the relative error at Chebyshev nodes. In float32, powers
    included, the relative error is 2e-6.
    """
    y = 0.5725 * np.cos(np.linspace(0.0, np.pi, 400)) - 0.5525
    relative = np.vander(y, 6, increasing=True) / np.exp2(y)[:, None]
    coefficients = np.linalg.lstsq(relative, np.ones_like(y), rcond=None)[0]
    return tuple(np.float32(c) for c in coefficients * 8.0 ** -np.arange(6))


P0, P1, P2, P3, P4, P5 = _exp2_coefficients()
EXP2_MIN = np.float32(-9)


@inlined
def exp2_8(t: Any) -> Any:
    """2^t for t <= 0; below -9 (alpha under 1/512) it returns 2^-9, which the cut removes."""
    t = max8(t, broadcast8(EXP2_MIN))
    t2 = t * t
    root = (P0 + t * P1) + t2 * ((P2 + t * P3) + t2 * (P4 + t * P5))  # Estrin: a short chain of operations
    root = root * root
    root = root * root
    return root * root


@inlined
def row_pieces_in_half(ridge: Any, row_log2: Any, bend_x: np.float32, left: np.float32) -> Any:
    """Which of eight rows reach alpha >= 1/255 between ``left`` and ``left`` + 7 (dx of pixel centres)."""
    nearest = min8(max8(ridge, broadcast8(left)), broadcast8(left + SEVEN)) - ridge
    return mask_bits(row_log2 - nearest * nearest * bend_x >= TOUCH_CUT)


@inlined
def set_up_splat(
    splats: Floats, g: Any, left: np.float32, top: np.float32, buffer: Floats, geometry: int
) -> Any:
    """Write the splat's geometry in this tile and return the bit mask of the vectors that it touches."""
    bend_x, bend_y, skew = splats[g, BEND_X], splats[g, BEND_Y], splats[g, SKEW]
    log2_opacity = splats[g, LOG2_OPACITY]
    dx = left + HALF - splats[g, MEAN_X]
    dy0 = lane_numbers() + (top + HALF - splats[g, MEAN_Y])
    dy1 = dy0 + EIGHT
    log0 = log2_opacity - dy0 * dy0 * bend_y
    log1 = log2_opacity - dy1 * dy1 * bend_y
    ridge0 = dy0 * skew
    ridge1 = dy1 * skew
    columns = lane_numbers() + dx
    store8(buffer, geometry + ROW_LOG2, log0)
    store8(buffer, geometry + ROW_LOG2 + LANES, log1)
    store8(buffer, geometry + ROW_RIDGE, ridge0)
    store8(buffer, geometry + ROW_RIDGE + LANES, ridge1)
    store8(buffer, geometry + ROW_DY, dy0)
    store8(buffer, geometry + ROW_DY + LANES, dy1)
    store8(buffer, geometry + COLUMN_DX, columns)
    store8(buffer, geometry + COLUMN_DX + LANES, columns + EIGHT)
    right = dx + EIGHT
    touched = row_pieces_in_half(ridge0, log0, bend_x, dx)
    touched |= row_pieces_in_half(ridge1, log1, bend_x, dx) << 8
    touched |= row_pieces_in_half(ridge0, log0, bend_x, right) << 16
    touched |= row_pieces_in_half(ridge1, log1, bend_x, right) << 24
    return touched


@device
def forward_tile(
    begin: int,
    end: int,
    left: np.float32,
    top: np.float32,
    pair_ids: Array,
    splats: Floats,
    buffer: Floats,
    depth: Floats | None,
) -> None:
    """Blend the pairs ``begin`` to ``end`` into the pixel buffers."""
    zero = broadcast8(ZERO)
    alpha_max = broadcast8(ALPHA_MAX)
    alive = ALL_PIECES
    start = begin
    while start < end and alive != 0:
        stop = min(start + ALIVE_INTERVAL, end)
        for pair in range(start, stop):
            g = pair_ids[np.uint64(pair)]
            touched = set_up_splat(splats, g, left, top, buffer, GEOMETRY_FORWARD) & alive
            bend_x = splats[g, BEND_X]
            red, green, blue, z = splats[g, RED], splats[g, GREEN], splats[g, BLUE], splats[g, DEPTH]
            number = broadcast8(np.float32(pair - begin + 1))
            while touched != 0:
                piece = lowest_bit(touched)
                touched &= touched - 1
                row = np.uint64(GEOMETRY_FORWARD + (piece & 15))
                column = GEOMETRY_FORWARD + COLUMN_DX + ((piece >> 4) << 3)
                pixel = piece * LANES
                u = load8(buffer, column) - buffer[row + np.uint64(ROW_RIDGE)]
                log2_alpha = buffer[row + np.uint64(ROW_LOG2)] - u * u * bend_x
                before = load8(buffer, T_FORWARD + pixel)
                alpha = min8(exp2_8(log2_alpha), alpha_max)
                alpha = select8(alpha >= ALPHA_CUT, alpha, zero)
                weight = alpha * before
                after = before - weight
                goes_on = after >= TRANSMITTANCE_STOP
                weight = select8(goes_on, weight, zero)
                store8(buffer, T_FORWARD + pixel, select8(goes_on, after, negative_magnitude8(before)))
                last = select8(weight > ZERO, number, zero)
                store8(buffer, LAST_FORWARD + pixel, max8(last, load8(buffer, LAST_FORWARD + pixel)))
                store8(buffer, RED_FORWARD + pixel, load8(buffer, RED_FORWARD + pixel) + weight * red)
                store8(buffer, GREEN_FORWARD + pixel, load8(buffer, GREEN_FORWARD + pixel) + weight * green)
                store8(buffer, BLUE_FORWARD + pixel, load8(buffer, BLUE_FORWARD + pixel) + weight * blue)
                if depth is not None:
                    store8(buffer, DEPTH_FORWARD + pixel, load8(buffer, DEPTH_FORWARD + pixel) + weight * z)
        start = stop
        alive = np.int64(0)
        for piece in range(PIECES):
            if any8(load8(buffer, T_FORWARD + piece * LANES) > ZERO):
                alive |= np.int64(1) << piece


@inlined
def pixel_offset(row: int, column: int) -> Any:
    """Place of a tile's pixel in a half-major buffer."""
    return np.uint64(((column >> 3) << 7) + row * LANES + (column & 7))


@kernel
def forward(
    width: int,
    height: int,
    tile_offsets: Array,
    pair_ids: Array,
    splats: Floats,
    background: Floats,
    image: Floats,
    transmittance: Floats,
    last: Floats,
    depth: Floats | None,
) -> None:
    """Image [H, W, 3], final transmittance [H, W], last contributor [H, W], and depth [H, W] or None."""
    tiles_x = (width + TILE - 1) // TILE
    tiles_y = (height + TILE - 1) // TILE
    for tile in prange(tiles_x * tiles_y):
        buffer = np.empty(FORWARD_SIZE, np.float32)
        left, top = (tile % tiles_x) * TILE, (tile // tiles_x) * TILE
        columns, rows = min(TILE, width - left), min(TILE, height - top)
        for i in range(GEOMETRY_FORWARD):
            buffer[i] = ZERO
        for i in range(TILE_PIXELS):
            buffer[T_FORWARD + i] = -ONE
        for row in range(rows):
            for column in range(columns):
                buffer[T_FORWARD + pixel_offset(row, column)] = ONE
        forward_tile(
            tile_offsets[tile],
            tile_offsets[tile + 1],
            np.float32(left),
            np.float32(top),
            pair_ids,
            splats,
            buffer,
            depth,
        )
        for row in range(rows):
            for column in range(columns):
                y, x, i = top + row, left + column, pixel_offset(row, column)
                rest = abs(buffer[T_FORWARD + i])
                image[y, x, 0] = buffer[RED_FORWARD + i] + rest * background[0]
                image[y, x, 1] = buffer[GREEN_FORWARD + i] + rest * background[1]
                image[y, x, 2] = buffer[BLUE_FORWARD + i] + rest * background[2]
                transmittance[y, x] = rest
                last[y, x] = buffer[LAST_FORWARD + i]
                if depth is not None:
                    depth[y, x] = buffer[DEPTH_FORWARD + i]


@device
def backward_tile(
    begin: int,
    end: int,
    left: np.float32,
    top: np.float32,
    pair_ids: Array,
    pair_slots: Array,
    splats: Floats,
    buffer: Floats,
    pair_sums: Floats,
    grad_depth: Floats | None,
) -> None:
    """Walk the pairs ``end`` - 1 down to ``begin`` and write each one's sums to its row of ``pair_sums``."""
    zero = broadcast8(ZERO)
    alpha_max = broadcast8(ALPHA_MAX)
    nowhere = broadcast8(EXP2_MIN)
    stride = pair_sums.shape[1]
    for pair in range(end - 1, begin - 1, -1):
        g = pair_ids[np.uint64(pair)]
        bend_x = splats[g, BEND_X]
        red, green, blue, z = splats[g, RED], splats[g, GREEN], splats[g, BLUE], splats[g, DEPTH]
        number = np.float32(pair - begin + 1)
        touched = set_up_splat(splats, g, left, top, buffer, GEOMETRY_BACKWARD)
        contributes = mask_bits(load8(buffer, LAST_OF_PIECE) >= number)
        contributes |= mask_bits(load8(buffer, LAST_OF_PIECE + 8) >= number) << 8
        contributes |= mask_bits(load8(buffer, LAST_OF_PIECE + 16) >= number) << 16
        contributes |= mask_bits(load8(buffer, LAST_OF_PIECE + 24) >= number) << 24
        touched &= contributes
        sum_v = sum_vu = sum_vy = sum_vuu = sum_vuy = sum_vyy = zero
        sum_red = sum_green = sum_blue = sum_depth = zero
        while touched != 0:
            piece = lowest_bit(touched)
            touched &= touched - 1
            row = np.uint64(GEOMETRY_BACKWARD + (piece & 15))
            column = GEOMETRY_BACKWARD + COLUMN_DX + ((piece >> 4) << 3)
            pixel = piece * LANES
            dy = buffer[row + np.uint64(ROW_DY)]
            u = load8(buffer, column) - buffer[row + np.uint64(ROW_RIDGE)]
            log2_alpha = buffer[row + np.uint64(ROW_LOG2)] - u * u * bend_x
            log2_alpha = select8(load8(buffer, LAST_BACKWARD + pixel) >= number, log2_alpha, nowhere)
            raw_alpha = exp2_8(log2_alpha)
            alpha = select8(raw_alpha >= ALPHA_CUT, min8(raw_alpha, alpha_max), zero)
            inverse = ONE / (ONE - alpha)
            before = load8(buffer, T_BACKWARD + pixel) * inverse
            store8(buffer, T_BACKWARD + pixel, before)
            weight = alpha * before
            grad_r = load8(buffer, GRAD_RED + pixel)
            grad_g = load8(buffer, GRAD_GREEN + pixel)
            grad_b = load8(buffer, GRAD_BLUE + pixel)
            gain = grad_r * red + grad_g * green + grad_b * blue
            if grad_depth is not None:
                grad_z = load8(buffer, GRAD_DEPTH + pixel)
                gain = gain + grad_z * z
                sum_depth = sum_depth + weight * grad_z
            own = weight * gain
            behind = load8(buffer, BEHIND + pixel)
            v = select8(raw_alpha < ALPHA_MAX, own - alpha * (behind * inverse), zero)
            store8(buffer, BEHIND + pixel, behind + own)
            vu = v * u
            vy = v * dy
            sum_v = sum_v + v
            sum_vu = sum_vu + vu
            sum_vy = sum_vy + vy
            sum_vuu = sum_vuu + vu * u
            sum_vuy = sum_vuy + vu * dy
            sum_vyy = sum_vyy + vy * dy
            sum_red = sum_red + weight * grad_r
            sum_green = sum_green + weight * grad_g
            sum_blue = sum_blue + weight * grad_b
        slot = np.uint64(pair_slots[np.uint64(pair)])
        # Columns SUM_V to SUM_GREEN, in the order of the layout.
        sums = lane_sums(sum_v, sum_vu, sum_vy, sum_vuu, sum_vuy, sum_vyy, sum_red, sum_green)
        store8(pair_sums, slot * np.uint64(stride), sums)
        pair_sums[slot, SUM_BLUE] = lane_sum(sum_blue)
        if grad_depth is not None:
            pair_sums[slot, SUM_DEPTH] = lane_sum(sum_depth)


@kernel
def backward(
    width: int,
    height: int,
    tile_offsets: Array,
    pair_ids: Array,
    pair_slots: Array,
    splats: Floats,
    background: Floats,
    transmittance: Floats,
    last: Floats,
    grad_image: Floats,
    grad_alpha: Floats | None,
    grad_depth: Floats | None,
    pair_sums: Floats,
) -> None:
    """Sums of every (tile, splat) pair, Gaussian-major: [P, 10] with depth, else [P, 9]."""
    tiles_x = (width + TILE - 1) // TILE
    tiles_y = (height + TILE - 1) // TILE
    for tile in prange(tiles_x * tiles_y):
        buffer = np.empty(BACKWARD_SIZE, np.float32)
        left, top = (tile % tiles_x) * TILE, (tile // tiles_x) * TILE
        columns, rows = min(TILE, width - left), min(TILE, height - top)
        for i in range(GEOMETRY_BACKWARD):
            buffer[i] = ZERO
        for row in range(rows):
            for column in range(columns):
                y, x, i = top + row, left + column, pixel_offset(row, column)
                rest = transmittance[y, x]
                red, green, blue = grad_image[y, x, 0], grad_image[y, x, 1], grad_image[y, x, 2]
                behind = red * background[0] + green * background[1] + blue * background[2]
                if grad_alpha is not None:  # alpha = 1 - T
                    behind -= grad_alpha[y, x]
                if grad_depth is not None:
                    buffer[GRAD_DEPTH + i] = grad_depth[y, x]
                buffer[T_BACKWARD + i] = rest
                buffer[LAST_BACKWARD + i] = last[y, x]
                buffer[BEHIND + i] = rest * behind
                buffer[GRAD_RED + i] = red
                buffer[GRAD_GREEN + i] = green
                buffer[GRAD_BLUE + i] = blue
        deepest = ZERO
        for piece in range(PIECES):
            largest = ZERO
            for lane in range(LANES):
                largest = max(largest, buffer[LAST_BACKWARD + piece * LANES + lane])
            buffer[LAST_OF_PIECE + piece] = largest
            deepest = max(deepest, largest)
        begin = tile_offsets[tile]
        end = begin + np.int64(deepest)
        for pair in range(end, tile_offsets[tile + 1]):
            slot = pair_slots[pair]
            for column in range(pair_sums.shape[1]):
                pair_sums[slot, column] = ZERO
        backward_tile(
            begin,
            end,
            np.float32(left),
            np.float32(top),
            pair_ids,
            pair_slots,
            splats,
            buffer,
            pair_sums,
            grad_depth,
        )
