"""Work of a view: operations and bytes of the kernels, counted from their source.

A float addition, multiplication, comparison, minimum, maximum, selection, division, root or exponential is
one operation; a fused multiply-add is two. Only operations that contribute to a pixel count: a vector lane
outside the ellipse is overhead. Bytes are those that must move at least once between kernel and memory: each
array that the kernel reads or writes, and one row per (tile, splat) pair if it gathers.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import prange

from benchmarks.speed.probe import KERNELS
from cleargs.splat import constants
from cleargs.splat.kernels.cpu.jit import kernel
from cleargs.splat.kernels.cpu.pieces import PIECES
from cleargs.splat.kernels.cpu.pipeline import CpuForwardPass
from cleargs.splat.kernels.cpu.simd import LANES
from cleargs.splat.kernels.splat_layout import BEND_X, BEND_Y, LOG2_OPACITY, MEAN_X, MEAN_Y, SKEW, TILE
from cleargs.types import AnyArray, ArrayF32

ALPHA_CUT = np.float32(constants.ALPHA_CUT)
PIXEL_CENTRE = np.float32(constants.PIXEL_CENTRE)

PARAMETER_COUNT = 59
"""Parameters of a Gaussian of SH degree 3: 3 + 3 + 4 + 1 + 48."""
PARAMETER_BYTES = 4 * PARAMETER_COUNT
"""Bytes of the parameters in float32."""
SPLAT_BYTES = 64
"""Bytes of a packed splat, one cache line."""
SETUP_OPERATIONS = LANES * (6 * (TILE // LANES) + 7 * (TILE // LANES) ** 2)
"""Operations that set up a pair in its tile: six vector operations per block of rows, and seven per block of
rows and columns."""
PAIR_SUM_BYTES = 36
"""Bytes of the gradient sums of a pair, without depth."""


class Size(NamedTuple):
    """Numbers that determine the work of a view."""

    gaussians: int
    pairs: int  # (tile, splat)
    contributions: int  # (splat, pixel) with an alpha of at least 1/255, before the pixel is opaque
    vectors: int  # (splat, LANES pixels of a row) with a contribution
    pixels: int


class KernelWork(NamedTuple):
    """Operations and bytes of one kernel."""

    operations: float
    bytes: float


def size_of(frame: CpuForwardPass) -> Size:
    """Count the pairs, contributions and vectors of a view."""
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
    """Count contributions and vectors per tile, up to each pixel's last contributor: ``counts`` [T, 2]."""
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
    """Return the work of all kernels of an iteration (SH degree 3, no depth), in the order of `KERNELS`."""
    n, pairs, hits, _, pixels = size
    values = 3 * pixels
    work = {
        # Mostly float64: position 18, quaternion 13, axes 45, Jacobian 24, covariance 63, ellipse 30,
        # direction 12, harmonics 70, colour 96.
        "projection.project": KernelWork(371 * n, n * (PARAMETER_BYTES + SPLAT_BYTES + 8 + 4)),
        "binning.pair_ranges": KernelWork(0, n * 16),
        # Counts and depths once (a cache line each), then three passes over keys and indices.
        "binning.depth_order": KernelWork(0, n * (8 + SPLAT_BYTES + 8 + 3 * 16)),
        "binning.list_pairs": KernelWork(0, n * (SPLAT_BYTES + 8) + pairs * 4),
        # A count, then the sort: tiles are read twice, Gaussian and slot written.
        "binning.sort_pairs_by_tile": KernelWork(0, 2 * n * 12 + pairs * 16),
        # Per pair: its geometry in the tile. Per contribution: exponent 4, exp2 15, weight and T 3, cut-offs
        # and last contributor 9, three colours 6.
        "rasterise.forward": KernelWork(
            SETUP_OPERATIONS * pairs + 37 * hits, pairs * (4 + SPLAT_BYTES) + pixels * 20
        ),
        # Padded copies of both images and of the mask.
        "loss.pad_images": KernelWork(0, values * 20),
        # Two passes of eleven taps (10 operations down, 10 across), then SSIM and its derivatives.
        "loss.measure": KernelWork(257 * values, values * 24),
        # Two passes of eleven taps over three maps, then the sum.
        "loss.differentiate": KernelWork(144 * values, values * 28),
        # Per pair: the setup of forward, a test per piece, nine sums over the lanes. Per contribution: alpha
        # 24, previous T 2, gain, S and v 12, nine sums 17.
        "rasterise.backward": KernelWork(
            (SETUP_OPERATIONS + PIECES + 9 * (LANES - 1)) * pairs + 55 * hits,
            pairs * (4 + 4 + SPLAT_BYTES + PAIR_SUM_BYTES) + pixels * 20,
        ),
        # Projection and its chain rule, mostly in float64; nine additions per pair.
        "gradients.backpropagate": KernelWork(
            780 * n + 9 * pairs, n * (2 * PARAMETER_BYTES + SPLAT_BYTES + 8) + pairs * PAIR_SUM_BYTES
        ),
        "elementwise.adam": KernelWork(13 * PARAMETER_COUNT * n, 28 * PARAMETER_COUNT * n),
    }
    return {name: work[name] for name in KERNELS}
