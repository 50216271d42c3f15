"""Tile rasterisation, forward and backward.

The forward pass visits the tile's splats from near to far. For each pixel, with the transmittance T, which
is 1 initially, it computes

    alpha = min(2^(log2 alpha), 0.999), skipped below 1/255
    stop if T (1 - alpha) < 1e-4
    colour += alpha T c,   depth += alpha T z,   T *= 1 - alpha

and finally image = colour + T background. The backward pass goes from far to near. With g = dL/d(pixel),
w = alpha T, and S = g · b, where b is the colour of all that is behind the splat, with nothing before it,

    v = dL/d(ln alpha) = w (g · c - S),   0 where alpha is clamped,      S += alpha (g · c - S).

For each (tile, splat) pair, the gradients need only the sums of v, v u, v dy, v u², v u dy, v dy² and w g
(``splat_layout.SUM_*``). ``gradients.backpropagate`` turns them into gradients once per Gaussian. Each pair
has its own row of scratch, so there are no atomics, no races and no dependence on the number of threads.

The pixels of a tile are stored in a small buffer, divided into pieces: the LANES pixels of a row that form a
vector. Piece 16 h + r is row r of the tile's h-th block of LANES columns. There is one block if a vector
holds a whole row, else two. Only the pieces that the ellipse touches are visited; one pass finds them all.

The geometry of a batch of splats is computed before any of them is blended. The loads of many splats then
wait for memory together, and the pieces of a splat are known before the loop over them begins. Data of the
next batch is prefetched meanwhile.

Depth is an optional fourth channel. If its array is None, Numba compiles the kernel without it.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import prange

from cleargs.splat import constants
from cleargs.splat.kernels import splat_layout as layout
from cleargs.splat.kernels.cpu.jit import device, inlined, kernel
from cleargs.splat.kernels.cpu.simd import (
    LANES,
    any_lane,
    broadcast,
    lane_numbers,
    lane_sum,
    load,
    lowest_bit,
    mask_bits,
    maximum,
    minimum,
    negative_magnitude,
    prefetch,
    prefetch_to_write,
    select,
    store,
    store_lane_sums,
)
from cleargs.types import AnyArray, ArrayF32

ZERO, ONE, HALF = (np.float32(x) for x in (0, 1, 0.5))
ALPHA_MAX = np.float32(constants.ALPHA_MAX)
ALPHA_CUT = np.float32(constants.ALPHA_CUT)
TRANSMITTANCE_STOP = np.float32(constants.TRANSMITTANCE_STOP)
TOUCH_CUT = np.float32(constants.LOG2_ALPHA_CUT - 2e-3)
"""A piece is visited if log2(alpha) reaches this; the final decision is made per pixel."""

BATCH = 16
"""Splats whose geometry is computed before they are blended. Pieces without a live pixel are then dropped."""

PIECES = layout.TILE_PIXELS // LANES
ALL_PIECES = np.int64(2**PIECES - 1)
LAST_LANE = np.float32(LANES - 1)

# Geometry of the batch's splats, stored after the pixel buffers: one value per tile row or column of each.
ROW_LOG2 = 0  # log2 alpha on the ridge of each row, [16]
ROW_RIDGE = 16  # dx of the ridge of each row, [16]
ROW_DY = 32  # dy of each row, [16]
COLUMN_DX = 48  # dx of each column, [16]
GEOMETRY_SIZE = 64

# Pixel buffers of the forward pass. The sign of T marks finished pixels (and those outside the image).
T_FORWARD = 0
LAST_FORWARD = 256  # number, from 1, of the last splat that contributed; exact up to 2^24 splats per tile
RED_FORWARD = 512
GREEN_FORWARD = 768
BLUE_FORWARD = 1024
DEPTH_FORWARD = 1280
GEOMETRY_FORWARD = 1536
FORWARD_SIZE = GEOMETRY_FORWARD + BATCH * GEOMETRY_SIZE

# Pixel buffers of the backward pass.
T_BACKWARD = 0
LAST_BACKWARD = 256
BEHIND = 512  # S
GRAD_RED = 768
GRAD_GREEN = 1024
GRAD_BLUE = 1280
GRAD_DEPTH = 1536
LAST_OF_PIECE = 1792  # the largest LAST of each piece, [PIECES]
GEOMETRY_BACKWARD = 1824
BACKWARD_SIZE = GEOMETRY_BACKWARD + BATCH * GEOMETRY_SIZE


def _exp2_coefficients() -> tuple[np.float32, ...]:
    """Return the coefficients of the polynomial p of degree 5 with p(t)^8 = 2^t on [-9, 0.16].

    p is fitted by least squares of the relative error, which for p(t)^8 in float32 is 2e-6, at Chebyshev
    nodes.
    """
    y = 0.5725 * np.cos(np.linspace(0.0, np.pi, 400)) - 0.5525
    relative = np.vander(y, 6, increasing=True) / np.exp2(y)[:, None]
    coefficients = np.linalg.lstsq(relative, np.ones_like(y), rcond=None)[0]
    return tuple(np.float32(c) for c in coefficients * 8.0 ** -np.arange(6))


P0, P1, P2, P3, P4, P5 = _exp2_coefficients()
EXP2_MIN = np.float32(-9)


@inlined
def exp2(t: Any) -> Any:
    """Return 2^t for t <= 0. Below -9 (alpha under 1/512) it returns 2^-9, which the cut at 1/255 removes."""
    t = maximum(t, broadcast(EXP2_MIN))
    t2 = t * t
    root = (P0 + t * P1) + t2 * ((P2 + t * P3) + t2 * (P4 + t * P5))  # Estrin's scheme, a short chain
    root = root * root
    root = root * root
    return root * root


@inlined
def set_up_splat(
    splats: ArrayF32, g: Any, left: np.float32, top: np.float32, buffer: ArrayF32, geometry: int
) -> Any:
    """Write the splat's geometry in this tile and return the bit mask of the pieces that it touches."""
    bend_x, bend_y, skew = splats[g, layout.BEND_X], splats[g, layout.BEND_Y], splats[g, layout.SKEW]
    dx, dy0 = left + HALF - splats[g, layout.MEAN_X], top + HALF - splats[g, layout.MEAN_Y]
    touched = np.int64(0)
    for first in range(0, layout.TILE, LANES):
        offset = np.float32(first)
        dy = lane_numbers() + (dy0 + offset)
        ridge = dy * skew
        row_log2 = splats[g, layout.LOG2_OPACITY] - dy * dy * bend_y
        store(buffer, geometry + ROW_LOG2 + first, row_log2)
        store(buffer, geometry + ROW_RIDGE + first, ridge)
        store(buffer, geometry + ROW_DY + first, dy)
        store(buffer, geometry + COLUMN_DX + first, lane_numbers() + (dx + offset))
        for column in range(0, layout.TILE, LANES):
            # Rows that reach alpha >= 1/255 between the centres of the block's outer pixels.
            outer = dx + np.float32(column)
            nearest = minimum(maximum(ridge, broadcast(outer)), broadcast(outer + LAST_LANE)) - ridge
            rows = mask_bits(row_log2 - nearest * nearest * bend_x >= TOUCH_CUT)
            touched |= rows << np.int64(column // LANES * layout.TILE + first)
    return touched


@inlined
def row_of(piece: Any) -> Any:
    """Return the row of the tile that contains a piece."""
    return np.uint64(piece & (layout.TILE - 1))


@inlined
def first_column(piece: Any) -> Any:
    """Return the column of the tile at which a piece starts."""
    return np.uint64((piece // layout.TILE) * LANES)


@inlined
def splat_offset(pair_ids: AnyArray, pair: Any) -> Any:
    """Return the offset of a pair's splat in the array of splats."""
    return np.uint64(pair_ids[np.uint64(pair)]) * np.uint64(layout.SPLAT_COLUMNS)


@device
def forward_tile(
    begin: int,
    end: int,
    left: np.float32,
    top: np.float32,
    pair_ids: AnyArray,
    splats: ArrayF32,
    buffer: ArrayF32,
    touches: AnyArray,  # [BATCH] int64 scratch
    depth: ArrayF32 | None,
) -> None:
    """Blend the pairs ``begin`` to ``end`` into the pixel buffers."""
    zero = broadcast(ZERO)
    alpha_max = broadcast(ALPHA_MAX)
    alive = ALL_PIECES
    start = begin
    while start < end and alive != 0:
        stop = min(start + BATCH, end)
        for pair in range(start, stop):
            prefetch(splats, splat_offset(pair_ids, min(pair + BATCH, end - 1)))
            geometry = GEOMETRY_FORWARD + (pair - start) * GEOMETRY_SIZE
            pieces = set_up_splat(splats, pair_ids[np.uint64(pair)], left, top, buffer, geometry)
            touches[pair - start] = pieces & alive
        for pair in range(start, stop):
            g = pair_ids[np.uint64(pair)]
            geometry = GEOMETRY_FORWARD + (pair - start) * GEOMETRY_SIZE
            touched = touches[np.uint64(pair - start)]
            bend_x = splats[g, layout.BEND_X]
            red, green, blue = splats[g, layout.RED], splats[g, layout.GREEN], splats[g, layout.BLUE]
            z = splats[g, layout.DEPTH]
            number = broadcast(np.float32(pair - begin + 1))
            while touched != 0:
                piece = lowest_bit(touched)
                touched &= touched - 1
                row = np.uint64(geometry) + row_of(piece)
                pixel = piece * LANES
                u = load(buffer, np.uint64(geometry + COLUMN_DX) + first_column(piece))
                u = u - buffer[row + np.uint64(ROW_RIDGE)]
                log2_alpha = buffer[row + np.uint64(ROW_LOG2)] - u * u * bend_x
                before = load(buffer, T_FORWARD + pixel)
                alpha = minimum(exp2(log2_alpha), alpha_max)
                alpha = select(alpha >= ALPHA_CUT, alpha, zero)
                weight = alpha * before
                after = before - weight
                goes_on = after >= TRANSMITTANCE_STOP
                weight = select(goes_on, weight, zero)
                store(buffer, T_FORWARD + pixel, select(goes_on, after, negative_magnitude(before)))
                last = select(weight > ZERO, number, zero)
                store(buffer, LAST_FORWARD + pixel, maximum(last, load(buffer, LAST_FORWARD + pixel)))
                store(buffer, RED_FORWARD + pixel, load(buffer, RED_FORWARD + pixel) + weight * red)
                store(buffer, GREEN_FORWARD + pixel, load(buffer, GREEN_FORWARD + pixel) + weight * green)
                store(buffer, BLUE_FORWARD + pixel, load(buffer, BLUE_FORWARD + pixel) + weight * blue)
                if depth is not None:
                    store(buffer, DEPTH_FORWARD + pixel, load(buffer, DEPTH_FORWARD + pixel) + weight * z)
        start = stop
        alive = np.int64(0)
        for piece in range(PIECES):
            if any_lane(load(buffer, T_FORWARD + piece * LANES) > ZERO):
                alive |= np.int64(1) << piece


@inlined
def pixel_offset(row: int, column: int) -> Any:
    """Return the offset of a tile's pixel in a buffer."""
    return np.uint64((column // LANES) * (layout.TILE * LANES) + row * LANES + column % LANES)


@kernel
def forward(
    width: int,
    height: int,
    tile_offsets: AnyArray,  # [tiles + 1]
    pair_ids: AnyArray,  # [P]
    splats: ArrayF32,  # [N, 16]
    background: ArrayF32,  # [3]
    image: ArrayF32,  # [H, W, 3], written
    transmittance: ArrayF32,  # [H, W], written
    last: ArrayF32,  # [H, W], written
    depth: ArrayF32 | None,  # [H, W], written
) -> None:
    """Render image, final transmittance, number of the last contributing splat and, if not None, depth."""
    tiles_x = (width + layout.TILE - 1) // layout.TILE
    tiles_y = (height + layout.TILE - 1) // layout.TILE
    for tile in prange(tiles_x * tiles_y):
        buffer = np.empty(FORWARD_SIZE, np.float32)
        touches = np.empty(BATCH, np.int64)
        left, top = (tile % tiles_x) * layout.TILE, (tile // tiles_x) * layout.TILE
        columns, rows = min(layout.TILE, width - left), min(layout.TILE, height - top)
        for i in range(GEOMETRY_FORWARD):
            buffer[i] = ZERO
        for i in range(layout.TILE_PIXELS):
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
            touches,
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
    pair_ids: AnyArray,
    pair_slots: AnyArray,
    splats: ArrayF32,
    buffer: ArrayF32,
    touches: AnyArray,  # [BATCH] int64 scratch
    pair_sums: ArrayF32,
    grad_depth: ArrayF32 | None,
) -> None:
    """Visit the pairs from ``end`` - 1 down to ``begin`` and write the sums of each to ``pair_sums``."""
    zero = broadcast(ZERO)
    alpha_max = broadcast(ALPHA_MAX)
    nowhere = broadcast(EXP2_MIN)
    stride = pair_sums.shape[1]
    stop = end
    while stop > begin:
        start = max(stop - BATCH, begin)
        for pair in range(stop - 1, start - 1, -1):
            prefetch_to_write(pair_sums, np.uint64(pair_slots[np.uint64(pair)]) * np.uint64(stride))
            prefetch(splats, splat_offset(pair_ids, max(pair - BATCH, begin)))
            geometry = GEOMETRY_BACKWARD + (pair - start) * GEOMETRY_SIZE
            pieces = set_up_splat(splats, pair_ids[np.uint64(pair)], left, top, buffer, geometry)
            number = np.float32(pair - begin + 1)
            contributes = np.int64(0)
            for first in range(0, PIECES, LANES):
                contributes |= mask_bits(load(buffer, LAST_OF_PIECE + first) >= number) << np.int64(first)
            touches[pair - start] = pieces & contributes
        for pair in range(stop - 1, start - 1, -1):
            g = pair_ids[np.uint64(pair)]
            geometry = GEOMETRY_BACKWARD + (pair - start) * GEOMETRY_SIZE
            touched = touches[np.uint64(pair - start)]
            bend_x = splats[g, layout.BEND_X]
            red, green, blue = splats[g, layout.RED], splats[g, layout.GREEN], splats[g, layout.BLUE]
            z = splats[g, layout.DEPTH]
            number = np.float32(pair - begin + 1)
            sum_v = sum_vu = sum_vy = sum_vuu = sum_vuy = sum_vyy = zero
            sum_red = sum_green = sum_blue = sum_depth = zero
            while touched != 0:
                piece = lowest_bit(touched)
                touched &= touched - 1
                row = np.uint64(geometry) + row_of(piece)
                pixel = piece * LANES
                dy = buffer[row + np.uint64(ROW_DY)]
                u = load(buffer, np.uint64(geometry + COLUMN_DX) + first_column(piece))
                u = u - buffer[row + np.uint64(ROW_RIDGE)]
                log2_alpha = buffer[row + np.uint64(ROW_LOG2)] - u * u * bend_x
                log2_alpha = select(load(buffer, LAST_BACKWARD + pixel) >= number, log2_alpha, nowhere)
                raw_alpha = exp2(log2_alpha)
                alpha = select(raw_alpha >= ALPHA_CUT, minimum(raw_alpha, alpha_max), zero)
                before = load(buffer, T_BACKWARD + pixel) / (ONE - alpha)
                store(buffer, T_BACKWARD + pixel, before)
                weight = alpha * before
                grad_r = load(buffer, GRAD_RED + pixel)
                grad_g = load(buffer, GRAD_GREEN + pixel)
                grad_b = load(buffer, GRAD_BLUE + pixel)
                gain = grad_r * red + grad_g * green + grad_b * blue
                if grad_depth is not None:
                    grad_z = load(buffer, GRAD_DEPTH + pixel)
                    gain = gain + grad_z * z
                    sum_depth = sum_depth + weight * grad_z
                behind = load(buffer, BEHIND + pixel)
                gain = gain - behind
                store(buffer, BEHIND + pixel, behind + alpha * gain)
                v = select(raw_alpha < ALPHA_MAX, weight * gain, zero)
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
            store_lane_sums(
                pair_sums,
                slot * np.uint64(stride),
                sum_v,
                sum_vu,
                sum_vy,
                sum_vuu,
                sum_vuy,
                sum_vyy,
                sum_red,
                sum_green,
            )
            pair_sums[slot, layout.SUM_BLUE] = lane_sum(sum_blue)
            if grad_depth is not None:
                pair_sums[slot, layout.SUM_DEPTH] = lane_sum(sum_depth)
        stop = start


@kernel
def backward(
    width: int,
    height: int,
    tile_offsets: AnyArray,  # [tiles + 1]
    pair_ids: AnyArray,  # [P]
    pair_slots: AnyArray,  # [P]
    splats: ArrayF32,  # [N, 16]
    background: ArrayF32,  # [3]
    transmittance: ArrayF32,  # [H, W]
    last: ArrayF32,  # [H, W]
    grad_image: ArrayF32,  # [H, W, 3]
    grad_alpha: ArrayF32 | None,  # [H, W]
    grad_depth: ArrayF32 | None,  # [H, W]
    pair_sums: ArrayF32,  # [P, 10] with depth, else [P, 9]; written
) -> None:
    """Write the sums of every (tile, splat) pair, in Gaussian-major order."""
    tiles_x = (width + layout.TILE - 1) // layout.TILE
    tiles_y = (height + layout.TILE - 1) // layout.TILE
    for tile in prange(tiles_x * tiles_y):
        buffer = np.empty(BACKWARD_SIZE, np.float32)
        touches = np.empty(BATCH, np.int64)
        left, top = (tile % tiles_x) * layout.TILE, (tile // tiles_x) * layout.TILE
        columns, rows = min(layout.TILE, width - left), min(layout.TILE, height - top)
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
                buffer[BEHIND + i] = behind
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
            touches,
            pair_sums,
            grad_depth,
        )
