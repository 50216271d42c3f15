"""Pieces of a tile, the geometry of a splat in them, and the exponential function.

The pixels of a tile are stored in a small buffer, divided into pieces: LANES pixels of a row, which form one
vector. Piece 16 h + r is row r of the tile's h-th block of LANES columns. There is one block if a vector
holds a whole row, else two. Only the pieces that the ellipse touches are visited; one pass finds them all.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from cleargs.splat import constants
from cleargs.splat.kernels import splat_layout as layout
from cleargs.splat.kernels.cpu.jit import inlined
from cleargs.splat.kernels.cpu.simd import LANES, broadcast, lane_numbers, mask_bits, maximum, minimum, store
from cleargs.types import AnyArray, ArrayF32

HALF = np.float32(0.5)
TOUCH_CUT = np.float32(constants.LOG2_ALPHA_CUT - 2e-3)
"""A piece is visited if log2(alpha) reaches this; the final decision is made per pixel."""

PIECES = layout.TILE_PIXELS // LANES
LAST_LANE = np.float32(LANES - 1)

# Geometry of a batch's splats, stored after the pixel buffers: per splat, one value per tile row or column.
ROW_LOG2 = 0  # log2 alpha on the ridge of each row, [16]
ROW_RIDGE = 16  # dx of the ridge of each row, [16]
ROW_DY = 32  # dy of each row, [16]
COLUMN_DX = 48  # dx of each column, [16]
GEOMETRY_SIZE = 64


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


@inlined
def pixel_offset(row: int, column: int) -> Any:
    """Return the offset of a tile's pixel in a buffer."""
    return np.uint64((column // LANES) * (layout.TILE * LANES) + row * LANES + column % LANES)
