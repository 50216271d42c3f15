"""Lists of the splats that touch each tile, in depth order, as in the CPU back end's ``binning``.

Depths are sorted once (N keys of 32 bits). Pairs are then listed in that order and sorted by tile (keys of 16
bits for up to 32,766 tiles). Both sorts are torch's stable ones, which are radix sorts on the GPU.
"""

from __future__ import annotations

import triton
import triton.language as tl

from cleargs.splat import constants
from cleargs.splat.kernels import splat_layout as layout
from cleargs.splat.kernels.cuda import device_layout


@triton.jit
def tile_range(low, high, tiles):
    """Return tiles [begin, end) with a pixel centre in the interval [low, high] px; 0, 0 if there is none."""
    # Bounded as floats first: the conversion of very large floats to integers is undefined.
    limit = (tiles * layout.TILE).to(tl.float64)
    first = tl.minimum(tl.maximum(tl.ceil(low - constants.PIXEL_CENTRE), 0.0), limit)
    last = tl.minimum(tl.maximum(tl.floor(high - constants.PIXEL_CENTRE), -1.0), limit - 1.0)
    some = first <= last
    begin = tl.where(some, first.to(tl.int32) // layout.TILE, 0)
    end = tl.where(some, last.to(tl.int32) // layout.TILE + 1, 0)
    return (begin, end)


@triton.jit
def reach_of_rows(extent_y):
    """Return the half height of the ellipse with its margin, float64."""
    return extent_y.to(tl.float64) * 1.001 + 0.001


@triton.jit
def tile_rows(mean_y, extent_y, height):
    """Return the rows of tiles [begin, end) that the ellipse alpha >= 1/255 may touch."""
    mean = mean_y.to(tl.float64)
    extent = reach_of_rows(extent_y)
    return tile_range(mean - extent, mean + extent, (height + layout.TILE - 1) // layout.TILE)


@triton.jit
def tile_columns(ellipse, row, width):
    """Return the tiles [begin, end) of one row of tiles that the ellipse alpha >= 1/255 touches.

    ``ellipse`` holds MEAN_X, MEAN_Y, BEND_X, SKEW, BEND_Y, LOG2_OPACITY, EXTENT_Y and EXTENT_X_AT. The CPU
    back end's ``tile_columns`` derives the formula.
    """
    mean_x, mean_y, bend_x, skew, bend_y, log2_opacity, extent_y, extent_x_at = ellipse
    mean = mean_y.to(tl.float64)
    extent = reach_of_rows(extent_y)
    line = (row * layout.TILE).to(tl.float64)
    low = tl.maximum(line + constants.PIXEL_CENTRE - mean, -extent)
    high = tl.minimum(line + layout.TILE - constants.PIXEL_CENTRE - mean, extent)
    at = extent_x_at.to(tl.float64)
    right_at = tl.minimum(tl.maximum(at, low), high)
    left_at = tl.minimum(tl.maximum(-at, low), high)
    a = tl.maximum(bend_x.to(tl.float64), 1e-30)
    e = bend_y.to(tl.float64)
    t = log2_opacity.to(tl.float64) - device_layout.LOG2_REACH_CUT
    k = skew.to(tl.float64)
    right = k * right_at + tl.sqrt(tl.maximum(t - e * right_at * right_at, 0.0) / a)
    left = k * left_at - tl.sqrt(tl.maximum(t - e * left_at * left_at, 0.0) / a)
    centre = mean_x.to(tl.float64)
    # MEAN_X and SKEW were rounded to float32 (6e-8), which matters if the mean is far away.
    margin = 1e-3 + 2e-7 * (tl.abs(centre) + tl.abs(k) * extent)
    return tile_range(
        centre + left - margin, centre + right + margin, (width + layout.TILE - 1) // layout.TILE
    )


@triton.jit
def count_tiles(ellipse, visible, width, height):
    """Return the number of tiles that each splat touches, int32; must agree with ``list_pairs``."""
    rows = tile_rows(ellipse[1], ellipse[6], height)
    top, bottom = tl.where(visible, rows[0], 0), tl.where(visible, rows[1], 0)
    count = tl.zeros_like(top)
    for step in range(0, tl.max(bottom - top, axis=0)):
        row = top + step
        columns = tile_columns(ellipse, row, width)
        count += tl.where(row < bottom, columns[1] - columns[0], 0)
    return count


@triton.jit(do_not_specialize=["n", "width", "height"])
def list_pairs(splats, order, tile_counts, pair_ends, pair_starts, pair_tiles, pair_owners, n, width, height):
    """Store tile and Gaussian of every slot, and each Gaussian's first slot ``pair_starts`` [N] int32.

    Lane r handles the Gaussian ``order[r]``, whose slots end before ``pair_ends[r]``.
    """
    rank = tl.program_id(0) * device_layout.LIST_BLOCK + tl.arange(0, device_layout.LIST_BLOCK)
    mask = rank < n
    g = tl.load(order + rank, mask=mask, other=0).to(tl.int32)
    count = tl.load(tile_counts + g, mask=mask, other=0)
    end = tl.load(pair_ends + rank, mask=mask, other=0)
    slot = end - count
    tl.store(pair_starts + g, slot.to(tl.int32), mask=mask)
    some = count > 0
    row = splats + g * layout.SPLAT_COLUMNS
    mean_x = tl.load(row + layout.MEAN_X, mask=some, other=0.0)
    mean_y = tl.load(row + layout.MEAN_Y, mask=some, other=0.0)
    bend_x = tl.load(row + layout.BEND_X, mask=some, other=1.0)
    skew = tl.load(row + layout.SKEW, mask=some, other=0.0)
    bend_y = tl.load(row + layout.BEND_Y, mask=some, other=1.0)
    log2_opacity = tl.load(row + layout.LOG2_OPACITY, mask=some, other=0.0)
    extent_y = tl.load(row + layout.EXTENT_Y, mask=some, other=0.0)
    extent_x_at = tl.load(row + layout.EXTENT_X_AT, mask=some, other=0.0)
    ellipse = (mean_x, mean_y, bend_x, skew, bend_y, log2_opacity, extent_y, extent_x_at)
    tiles_x = (width + layout.TILE - 1) // layout.TILE
    rows = tile_rows(mean_y, extent_y, height)
    top, bottom = tl.where(some, rows[0], 0), tl.where(some, rows[1], 0)
    for step in range(0, tl.max(bottom - top, axis=0)):
        tile_row = top + step
        columns = tile_columns(ellipse, tile_row, width)
        length = tl.where(tile_row < bottom, columns[1] - columns[0], 0)
        tile = tile_row * tiles_x + columns[0]
        for column in range(0, tl.max(length, axis=0)):
            fits = (column < length) & (slot + column < end)
            tl.store(pair_tiles + slot + column, (tile + column).to(pair_tiles.dtype.element_ty), mask=fits)
            tl.store(pair_owners + slot + column, g, mask=fits)
        slot += length


@triton.jit(do_not_specialize=["pairs", "tiles", "halvings"])
def place_pairs(
    sorted_tiles, sorted_slots, pair_owners, pair_ids, pair_slots, tile_starts, pairs, tiles, halvings
):
    """Store Gaussian and slot of every place, and each tile's first place and the end: ``tile_starts``.

    A lane is a place, and a tile of ``tile_starts`` [tiles + 1] if there are as many. It bisects the sorted
    tiles ``halvings`` times.
    """
    lane = tl.program_id(0).to(tl.int64) * device_layout.PLACE_BLOCK + tl.arange(0, device_layout.PLACE_BLOCK)
    some = lane < pairs
    slot = tl.load(sorted_slots + lane, mask=some, other=0)
    tl.store(pair_slots + lane, slot.to(tl.int32), mask=some)
    tl.store(pair_ids + lane, tl.load(pair_owners + slot, mask=some, other=0), mask=some)
    if tl.program_id(0) * device_layout.PLACE_BLOCK <= tiles:
        low = tl.zeros_like(lane)
        high = low + pairs
        for _ in range(0, halvings):
            middle = (low + high) // 2
            tile = tl.load(sorted_tiles + middle, mask=low < high, other=0)
            before = (low < high) & (tile < lane)
            low = tl.where(before, middle + 1, low)
            high = tl.where(before, high, middle)
        tl.store(tile_starts + lane, low.to(tl.int32), mask=lane <= tiles)
