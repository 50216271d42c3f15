"""How much work a view is: what the kernels must compute and must move, counted from their source.

Operations are float additions, multiplications, comparisons, minima, maxima, selections, divisions, roots
and exponentials, one each; a fused multiply-add is two. Only work that reaches a pixel counts: a lane of a
vector that the ellipse does not cover is overhead, not work. Bytes are those that must pass at least once
between the kernel and memory: every array that it reads or writes, and one row a (tile, splat) pair where it
gathers.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import prange

from benchmarks.speed.probe import KERNELS
from cleargs.splat import constants
from cleargs.splat.kernels.cpu.jit import kernel
from cleargs.splat.kernels.cpu.pipeline import CpuForwardPass
from cleargs.splat.kernels.cpu.rasterise import PIECES
from cleargs.splat.kernels.cpu.simd import LANES
from cleargs.splat.kernels.splat_layout import (
    BEND_X,
    BEND_Y,
    LOG2_OPACITY,
    MEAN_X,
    MEAN_Y,
    SKEW,
    TILE,
)
from cleargs.types import AnyArray, ArrayF32

ALPHA_CUT = np.float32(constants.ALPHA_CUT)
PIXEL_CENTRE = np.float32(constants.PIXEL_CENTRE)

VALUES = 59
"""Parameters of a Gaussian of SH degree 3: 3 + 3 + 4 + 1 + 48."""
PARAMETERS = 4 * VALUES
SPLAT = 64
"""Bytes of a packed splat, one cache line."""
SET_UP = LANES * (6 * (TILE // LANES) + 7 * (TILE // LANES) ** 2)
"""Operations that place a pair in its tile: six vectors a block of rows, seven a block of both."""
PAIR_SUMS = 36
"""Bytes of the sums of a pair without depth."""


class Size(NamedTuple):
    """What the work of a view grows with."""

    gaussians: int
    pairs: int  # (tile, splat)
    contributions: int  # (splat, pixel): alpha at least 1/255, and the pixel not finished before
    vectors: int  # (splat, LANES pixels of a row) with a contribution
    pixels: int


class KernelWork(NamedTuple):
    """Operations and bytes."""

    operations: float
    bytes: float


def size_of(frame: CpuForwardPass) -> Size:
    """The size of a view, its contributions counted one by one."""
    camera = frame.camera
    counts = np.zeros((len(frame.tile_offsets) - 1, 2), np.int64)
    count_contributions(
        camera.width, camera.height, frame.tile_offsets, frame.pair_ids, frame.splats, frame.last, counts
    )
    contributions, vectors = counts.sum(0).tolist()
    pixels = camera.width * camera.height
    return Size(frame.gaussians.num, len(frame.pair_ids), contributions, vectors, pixels)


@kernel
def count_contributions(
    width: int,
    height: int,
    tile_offsets: AnyArray,
    pair_ids: AnyArray,
    splats: ArrayF32,
    last: ArrayF32,
    counts: AnyArray,
) -> None:
    """Contributions and vectors of every tile, [T, 2]: those up to each pixel's last contributor."""
    tiles_x = (width + TILE - 1) // TILE
    for tile in prange(counts.shape[0]):
        left, top = (tile % tiles_x) * TILE, (tile // tiles_x) * TILE
        begin = tile_offsets[tile]
        for pair in range(begin, tile_offsets[tile + 1]):
            splat = splats[pair_ids[pair]]
            for y in range(top, min(top + TILE, height)):
                dy = np.float32(y) + PIXEL_CENTRE - splat[MEAN_Y]
                ridge = splat[LOG2_OPACITY] - dy * dy * splat[BEND_Y]
                for start in range(left, min(left + TILE, width), LANES):
                    hits = 0
                    for x in range(start, min(start + LANES, width)):
                        u = np.float32(x) + PIXEL_CENTRE - splat[MEAN_X] - splat[SKEW] * dy
                        alpha = np.exp2(ridge - u * u * splat[BEND_X])
                        hits += pair - begin < last[y, x] and alpha >= ALPHA_CUT
                    counts[tile, 0] += hits
                    counts[tile, 1] += hits > 0


def work_of(size: Size) -> dict[str, KernelWork]:
    """Work of every kernel of a training iteration (SH degree 3, no depth), in the order of KERNELS."""
    n, pairs, hits, _, pixels = size
    values = 3 * pixels
    work = {
        # Mostly float64: position 18, quaternion 13, axes 45, Jacobian 24, covariance 63, ellipse 30,
        # direction 12, harmonics 70, colour 96.
        "projection.project": KernelWork(371 * n, n * (PARAMETERS + SPLAT + 8 + 4)),
        "binning.pair_ranges": KernelWork(0, n * 16),
        # Counts and depths once (a cache line each), then three passes over keys and numbers.
        "binning.depth_order": KernelWork(0, n * (8 + SPLAT + 8 + 3 * 16)),
        "binning.list_pairs": KernelWork(0, n * (SPLAT + 8) + pairs * 4),
        # Counted, then placed: tiles read twice, Gaussian and slot written.
        "binning.sort_pairs_by_tile": KernelWork(0, 2 * n * 12 + pairs * 16),
        # A pair: its geometry in the tile. A contribution: exponent 4, exp2 15, weight and T 3, cut-offs and
        # the last contributor 9, three colours 6.
        "rasterise.forward": KernelWork(SET_UP * pairs + 37 * hits, pairs * (4 + SPLAT) + pixels * 20),
        # Planes are padded copies of both images and of the mask.
        "loss.pad_images": KernelWork(0, values * 20),
        # Eleven taps each way, 10 operations down and 10 across, then SSIM and its derivatives.
        "loss.measure": KernelWork(257 * values, values * 24),
        # Eleven taps of three maps each way, then the sum.
        "loss.differentiate": KernelWork(144 * values, values * 28),
        # A pair: as forward, which pieces it reaches, nine sums over the lanes. A contribution: alpha again
        # 24, T back 2, gain, S and v 12, nine sums 17.
        "rasterise.backward": KernelWork(
            (SET_UP + PIECES + 9 * (LANES - 1)) * pairs + 55 * hits,
            pairs * (4 + 4 + SPLAT + PAIR_SUMS) + pixels * 20,
        ),
        # Projection once more, then its chain rule, mostly in float64; nine additions a pair.
        "gradients.backpropagate": KernelWork(
            780 * n + 9 * pairs, n * (2 * PARAMETERS + SPLAT + 8) + pairs * PAIR_SUMS
        ),
        "elementwise.adam": KernelWork(13 * VALUES * n, 28 * VALUES * n),
    }
    return {name: work[name] for name in KERNELS}
