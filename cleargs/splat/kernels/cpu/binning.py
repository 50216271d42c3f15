"""List the splats that touch each tile, in depth order.

Depths are sorted once, by a stable radix sort (ties go by index). A stable two-pass counting sort by tile
then leaves the splats of every tile in depth order. Pairs are not sorted by depth, and the result does not
depend on how the work is split.

Pairs are numbered in two orders. The backward pass stores its sums in *Gaussian-major* order: all pairs of
Gaussian 0, of Gaussian 1, ... Rasterisation uses *tile-major* order. ``pair_slots`` maps the second to the
first.
"""

from __future__ import annotations

import math

import numpy as np
from numba import prange

from cleargs.splat import constants
from cleargs.splat.kernels import splat_layout as layout
from cleargs.splat.kernels.cpu.jit import exact, inlined, kernel, serial_kernel
from cleargs.splat.kernels.cpu.simd import prefetch
from cleargs.types import AnyArray, ArrayF32

REACH_MARGIN = 2e-3
"""Enlargement of the ellipses in log2(alpha); the rasteriser makes the final decision per pixel."""

LOG2_ALPHA_CUT = constants.LOG2_ALPHA_CUT - REACH_MARGIN
PIXEL_CENTRE = constants.PIXEL_CENTRE
BLOCK = 256
"""Gaussians per work item."""
AHEAD = 12
"""Number of Gaussians by which the prefetching of pairs is ahead; that of offsets is twice as far ahead."""
RADIX_BITS = 11
RADIX = 1 << RADIX_BITS
RADIX_PASSES = 3


@exact
def tile_range(low: float, high: float, tiles: int) -> tuple[int, int]:
    """Return the tiles [begin, end) with a pixel centre in [low, high] px; none if begin == end."""
    # Clamped as floats first: the conversion of huge numbers to integers is undefined.
    limit = np.float64(tiles * layout.TILE)
    first = min(max(np.ceil(low - PIXEL_CENTRE), 0.0), limit)
    last = min(max(np.floor(high - PIXEL_CENTRE), -1.0), limit - 1.0)
    if not first <= last:
        return 0, 0
    return int(first) // layout.TILE, int(last) // layout.TILE + 1


@exact
def tile_rows(splat: ArrayF32, height: int) -> tuple[int, int]:
    """Return the rows of tiles [begin, end) that the ellipse alpha >= 1/255 may touch."""
    mean = np.float64(splat[layout.MEAN_Y])
    extent = np.float64(splat[layout.EXTENT_Y]) * 1.001 + 0.001
    return tile_range(mean - extent, mean + extent, (height + layout.TILE - 1) // layout.TILE)


@exact
def tile_columns(splat: ArrayF32, row: int, width: int) -> tuple[int, int]:
    """Return the tiles [begin, end) of one row of tiles that the ellipse alpha >= 1/255 touches.

    The right edge x(dy) = k dy + sqrt((t - e dy²) / a) is concave. Within the row's band of pixel centres it
    is therefore largest at the ellipse's rightmost point, or at the line of the band nearest to it. The left
    edge is its mirror image.
    """
    extent = np.float64(splat[layout.EXTENT_Y]) * 1.001 + 0.001
    at = np.float64(splat[layout.EXTENT_X_AT])
    low = max(row * layout.TILE + PIXEL_CENTRE - np.float64(splat[layout.MEAN_Y]), -extent)
    high = min((row + 1) * layout.TILE - PIXEL_CENTRE - np.float64(splat[layout.MEAN_Y]), extent)
    right_at = min(max(at, low), high)
    left_at = min(max(-at, low), high)
    bend_x = max(np.float64(splat[layout.BEND_X]), 1e-30)
    bend_y = np.float64(splat[layout.BEND_Y])
    reach = np.float64(splat[layout.LOG2_OPACITY]) - LOG2_ALPHA_CUT
    skew = np.float64(splat[layout.SKEW])
    right = skew * right_at + math.sqrt(max(reach - bend_y * right_at * right_at, 0.0) / bend_x)
    left = skew * left_at - math.sqrt(max(reach - bend_y * left_at * left_at, 0.0) / bend_x)
    mean = np.float64(splat[layout.MEAN_X])
    return tile_range(mean + left - 1e-3, mean + right + 1e-3, (width + layout.TILE - 1) // layout.TILE)


@exact
def count_tiles(splat: ArrayF32, width: int, height: int) -> int:
    """Return the number of tiles that a splat touches; must agree with ``list_pairs``."""
    count = 0
    top, bottom = tile_rows(splat, height)
    for row in range(top, bottom):
        begin, end = tile_columns(splat, row, width)
        count += end - begin
    return count


@serial_kernel
def pair_ranges(tile_counts: AnyArray, pair_offsets: AnyArray) -> int:
    """Write prefix sums of the tile counts [N] as offsets [N + 1]; return the number of visible Gaussians."""
    total = 0
    visible = 0
    for g in range(tile_counts.shape[0]):
        pair_offsets[g] = total
        total += tile_counts[g]
        visible += tile_counts[g] > 0
    pair_offsets[tile_counts.shape[0]] = total
    return visible


@kernel
def depth_order(
    splats: ArrayF32, tile_counts: AnyArray, counts: AnyArray, keys: AnyArray, ids: AnyArray
) -> int:
    """Sort the visible Gaussians by ascending depth, ties by index; return the row of ``ids`` with the order.

    Positive floats sort like their bit patterns, so three passes of 11 bits are a full sort. ``counts``
    [chunks, `RADIX`], and ``keys`` and ``ids`` [2, visible] uint32, are scratch. Each chunk handles an equal
    part of the Gaussians; the result does not depend on their number.
    """
    chunks, total, n = counts.shape[0], tile_counts.shape[0], keys.shape[1]
    for chunk in prange(chunks):
        counts[chunk, 0] = 0
        for g in range(total * chunk // chunks, total * (chunk + 1) // chunks):
            counts[chunk, 0] += tile_counts[g] > 0
    start = 0
    for chunk in range(chunks):
        counts[chunk, 0], start = start, start + counts[chunk, 0]
    for chunk in prange(chunks):
        place = counts[chunk, 0]
        for g in range(total * chunk // chunks, total * (chunk + 1) // chunks):
            if tile_counts[g] > 0:
                keys[0, place] = splats[g, layout.DEPTH : layout.DEPTH + 1].view(np.uint32)[0]
                ids[0, place] = g
                place += 1
    mask = np.uint32(RADIX - 1)
    for digit in range(RADIX_PASSES):
        source, target, shift = digit % 2, 1 - digit % 2, np.uint32(RADIX_BITS * digit)
        for chunk in prange(chunks):
            counts[chunk, :] = 0
            for i in range(n * chunk // chunks, n * (chunk + 1) // chunks):
                counts[chunk, (keys[source, i] >> shift) & mask] += 1
        start = 0
        for value in range(RADIX):
            for chunk in range(chunks):
                counts[chunk, value], start = start, start + counts[chunk, value]
        for chunk in prange(chunks):
            for i in range(n * chunk // chunks, n * (chunk + 1) // chunks):
                key = keys[source, i]
                value = (key >> shift) & mask
                place = counts[chunk, value]
                counts[chunk, value] = place + 1
                keys[target, place] = key
                ids[target, place] = ids[source, i]
    return RADIX_PASSES % 2


@kernel
def list_pairs(
    splats: ArrayF32, pair_offsets: AnyArray, width: int, height: int, pair_tiles: AnyArray
) -> None:
    """Write the tile of every pair [P] in Gaussian-major order, row by row."""
    n = splats.shape[0]
    tiles_x = (width + layout.TILE - 1) // layout.TILE
    for block in prange((n + BLOCK - 1) // BLOCK):
        for g in range(block * BLOCK, min(n, (block + 1) * BLOCK)):
            pair = pair_offsets[g]
            if pair == pair_offsets[g + 1]:
                continue
            top, bottom = tile_rows(splats[g], height)
            for row in range(top, bottom):
                begin, end = tile_columns(splats[g], row, width)
                for column in range(begin, end):
                    pair_tiles[pair] = row * tiles_x + column
                    pair += 1


@inlined
def prefetch_pairs(i: int, end: int, order: AnyArray, pair_offsets: AnyArray, pair_tiles: AnyArray) -> None:
    """Prefetch what the loop over ``order`` reads next: in depth order, it is at random places in memory."""
    prefetch(pair_offsets, np.int64(order[min(i + 2 * AHEAD, end - 1)]))
    prefetch(pair_tiles, pair_offsets[order[min(i + AHEAD, end - 1)]])


@kernel
def sort_pairs_by_tile(
    order: AnyArray,  # [visible] Gaussians by depth
    pair_offsets: AnyArray,  # [N + 1]
    pair_tiles: AnyArray,  # [P]
    counts: AnyArray,  # [chunks, tiles] scratch
    tile_offsets: AnyArray,  # [tiles + 1], written
    pair_ids: AnyArray,  # [P], written: Gaussian of each pair
    pair_slots: AnyArray,  # [P], written: Gaussian-major number of each pair
) -> None:
    """Sort the pairs by tile with a stable counting sort that visits them in depth order.

    Each chunk of ``counts`` handles an equal part of ``order``; the result does not depend on their number.
    The pairs of tile ``t`` are ``tile_offsets[t]`` to ``tile_offsets[t + 1]`` of the last two arrays.
    """
    chunks, tiles = counts.shape
    n = order.shape[0]
    for chunk in prange(chunks):
        counts[chunk, :] = 0
        end = n * (chunk + 1) // chunks
        for i in range(n * chunk // chunks, end):
            prefetch_pairs(i, end, order, pair_offsets, pair_tiles)
            g = order[i]
            for pair in range(pair_offsets[g], pair_offsets[g + np.uint32(1)]):
                counts[chunk, pair_tiles[pair]] += 1
    start = 0
    for tile in range(tiles):
        tile_offsets[tile] = start
        for chunk in range(chunks):
            count = counts[chunk, tile]
            counts[chunk, tile] = start
            start += count
    tile_offsets[tiles] = start
    for chunk in prange(chunks):
        end = n * (chunk + 1) // chunks
        for i in range(n * chunk // chunks, end):
            prefetch_pairs(i, end, order, pair_offsets, pair_tiles)
            g = order[i]
            for pair in range(pair_offsets[g], pair_offsets[g + np.uint32(1)]):
                tile = pair_tiles[pair]
                place = counts[chunk, tile]
                counts[chunk, tile] = place + 1
                pair_ids[place] = g
                pair_slots[place] = pair
