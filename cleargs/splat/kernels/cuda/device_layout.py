"""What the GPU kernels hand on beyond the layouts of both back ends (``kernels.splat_layout``).

A *pair* is a (tile, splat) that touch. Pairs have two numberings: their *slot* (all pairs of the nearest
splat, of the next, ...), in which they are made and in which the backward pass leaves its sums, and their
*place* (all pairs of tile 0 from near to far, of tile 1, ...), in which they are blended.

A *chunk* is ``CHUNK`` places of one tile. The forward pass leaves the transmittance behind each chunk and the
colour that it added, so that the backward pass treats all chunks at once.
"""

from __future__ import annotations

import math

from cleargs.splat.constants import LOG2_ALPHA_CUT, SSIM_RADIUS, SSIM_SIGMA

CHUNK = 64
"""Pairs between two checkpoints of the forward pass."""

# Planes of TILE_PIXELS values that the forward pass leaves for each chunk.
CHUNK_TRANSMITTANCE = 0  # T behind the chunk
CHUNK_RED = 1  # what the chunk added to the pixel
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
"""Ellipses are taken larger by this much in log2(alpha) when tiles are listed; pixels decide alone."""


def _ssim_window() -> tuple[float, ...]:
    weights = [math.exp(-(i**2) / (2 * SSIM_SIGMA**2)) for i in range(-SSIM_RADIUS, SSIM_RADIUS + 1)]
    return tuple(weight / sum(weights) for weight in weights)


SSIM_WINDOW = _ssim_window()
"""The normalised one-dimensional window, 11 weights."""
