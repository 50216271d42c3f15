"""Layouts of the data between GPU kernels, next to those of both back ends (``kernels.splat_layout``).

A *pair* is a tile and a splat that touch. A pair has two numbers. Its *slot* counts by splat: all pairs of
the nearest splat, then of the next. Pairs are listed by slot, and the backward pass stores its sums by slot.
Its *place* counts by tile: all pairs of tile 0 from near to far, then of tile 1. Pairs are blended by place.

A *chunk* is ``CHUNK`` places of one tile. The first chunk of tile t, whose places begin at s, has the number
s // CHUNK + t. So each tile has as many numbers as it needs or one more, and nothing counts chunks. The
forward pass stores the transmittance behind each chunk and the colour that the chunk added, so that the
backward pass treats all chunks at the same time.
"""

from __future__ import annotations

import math

from cleargs.splat.constants import LOG2_ALPHA_CUT, SSIM_RADIUS, SSIM_SIGMA

CHUNK = 64
"""Pairs between two checkpoints of the forward pass."""

# Work of one program: numbers (Adam), Gaussians, places, or values of an image (loss).
NUMBERS_BLOCK = 1024
PROJECT_BLOCK = 128
LIST_BLOCK = 32
PLACE_BLOCK = 256
TOTAL_ROWS, TOTAL_BLOCK = 16, 16  # Gaussians, and pairs of a Gaussian that are added at a time
LOSS_ROWS, LOSS_COLUMNS = 4, 128  # rows of an image, and values in each
LOSS_SUMS = 256  # programs whose sums are added at a time

# Planes of TILE_PIXELS values that the forward pass stores for each chunk.
CHUNK_TRANSMITTANCE = 0  # transmittance behind the chunk
CHUNK_RED = 1  # colour that the chunk added to the pixel
CHUNK_GREEN = 2
CHUNK_BLUE = 3
CHUNK_DEPTH = 4
CHUNK_PLANES = 4  # 5 with depth

# A camera as the kernels read it: a row of float64.
VIEW_ROTATION = 0  # world to camera, row by row
VIEW_TRANSLATION = 9
VIEW_CENTRE = 12
VIEW_FX = 15
VIEW_FY = 16
VIEW_CX = 17
VIEW_CY = 18
VIEW_LEFT = 19  # bounds of x/z and y/z in the Jacobian
VIEW_RIGHT = 20
VIEW_TOP = 21
VIEW_BOTTOM = 22

FLOAT32_MAX = 3.4028234663852886e38
HALF_LOG2E = 0.5 / math.log(2.0)
TWO_LN2 = 2.0 * math.log(2.0)

LOG2_REACH_CUT = LOG2_ALPHA_CUT - 2e-3
"""Lower cut of log2(alpha) for the lists of tiles. Pixels use the exact cut."""


_WEIGHTS = [math.exp(-(i**2) / (2 * SSIM_SIGMA**2)) for i in range(-SSIM_RADIUS, SSIM_RADIUS + 1)]
SSIM_WINDOW = tuple(weight / sum(_WEIGHTS) for weight in _WEIGHTS)
"""The normalised one-dimensional window, 11 weights."""
