"""Memory layouts of both back ends: packed splats, pair sums, tiles.

A *splat* is a projected Gaussian. Its ellipse is stored with the square completed in x. With the
projected covariance Σ and d = pixel centre - projected mean,

    ½ dᵀ Σ⁻¹ d = ½ [ a (dx - k dy)² + e dy² ],   a = Σyy / det Σ,   k = Σxy / Σyy,   e = 1 / Σyy,

a sum of two non-negative terms. In float32, the usual A dx² + 2 B dx dy + C dy² loses its digits to
cancellation on thin ellipses; this sum does not. The logarithm of alpha, to base 2, is then

    log2 alpha = LOG2_OPACITY - BEND_X (dx - SKEW dy)² - BEND_Y dy²,

with BEND_X = ½ a log2(e) and BEND_Y = ½ e log2(e).
"""

from __future__ import annotations

# One packed splat: a row of 16 float32, one cache line.
MEAN_X = 0  # px
MEAN_Y = 1  # px
BEND_X = 2  # px⁻²
SKEW = 3  # horizontal shift per row of the ellipse's ridge, where alpha is largest
BEND_Y = 4  # px⁻²
LOG2_OPACITY = 5  # anti-aliasing compensation included
RED = 6
GREEN = 7
BLUE = 8
DEPTH = 9  # camera z
EXTENT_X = 10  # px, half width of the ellipse alpha = 1/255
EXTENT_Y = 11  # px, half height of this ellipse
EXTENT_X_AT = 12  # px, dy of its rightmost point
SPLAT_COLUMNS = 16

# Sums over the pixels of one (tile, splat) pair; with v = dL/d(ln alpha), u = dx - SKEW dy, w = alpha T.
SUM_V = 0
SUM_VU = 1
SUM_VY = 2
SUM_VUU = 3
SUM_VUY = 4
SUM_VYY = 5
SUM_RED = 6  # w dL/d(red of the pixel)
SUM_GREEN = 7
SUM_BLUE = 8
SUM_DEPTH = 9
PAIR_COLUMNS = 10

TILE = 16
"""Width and height of a tile in px, a power of two."""
TILE_PIXELS = TILE * TILE

MAX_PAIRS = 2**31 - 1
"""Largest number of (tile, splat) pairs: they are numbered with signed 32-bit integers."""
