"""Tile rasterisation, forward and backward.

The forward pass visits the tile's splats from near to far. For each pixel, with the transmittance T, which
is 1 initially, it computes

    alpha = min(2^(log2 alpha), 0.999), skipped below 1/255
    stop if T (1 - alpha) < 1e-4
    colour += alpha T c,   depth += alpha T z,   T *= 1 - alpha

and finally image = colour + T background. The backward pass goes from far to near. With g = dL/d(pixel),
w = alpha T, and S = g · b, where b is the colour behind the splat, as if nothing were in front of it,

    v = dL/d(ln alpha) = w (g · c - S),   0 where alpha is clamped,      S += alpha (g · c - S).

For each (tile, splat) pair, the gradients need only the sums of v, v u, v dy, v u², v u dy, v dy² and w g
(``splat_layout.SUM_*``). ``gradients.backpropagate`` turns them into gradients once per Gaussian. Each pair
has its own row of scratch, so there are no atomics, no races and no dependence on the number of threads.

Only the pieces of a tile (SIMD vectors of pixels: ``pieces``) that a splat touches are visited. The geometry
of a batch of splats is computed before any of them is blended. The loads of many splats then wait for memory
together, and the pieces of a splat are known before the loop over them begins. The next batch is prefetched.

Depth is an optional fourth channel. If its array is None, Numba compiles the kernel without it.
"""

from __future__ import annotations

import numpy as np
from numba import prange

from cleargs.splat import constants
from cleargs.splat.kernels import splat_layout as layout
from cleargs.splat.kernels.cpu.jit import inlined, kernel
from cleargs.splat.kernels.cpu.pieces import (
    COLUMN_DX,
    EXP2_MIN,
    GEOMETRY_SIZE,
    PIECES,
    ROW_DY,
    ROW_LOG2,
    ROW_RIDGE,
    exp2,
    first_column,
    pixel_offset,
    row_of,
    set_up_splat,
    splat_offset,
)
from cleargs.splat.kernels.cpu.simd import (
    LANES,
    any_lane,
    broadcast,
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

ZERO, ONE = np.float32(0), np.float32(1)
ALPHA_MAX = np.float32(constants.ALPHA_MAX)
ALPHA_CUT = np.float32(constants.ALPHA_CUT)
TRANSMITTANCE_STOP = np.float32(constants.TRANSMITTANCE_STOP)

BATCH = 16
"""Splats whose geometry is computed before they are blended. After a batch, finished pieces are dropped."""

ALL_PIECES = np.int64(2**PIECES - 1)

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


@inlined
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
        begin, end = tile_offsets[tile], tile_offsets[tile + 1]
        forward_tile(begin, end, np.float32(left), np.float32(top), pair_ids, splats, buffer, touches, depth)
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


@inlined
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
