"""Blur from what is left of fine detail, direction by direction.

Source: the re-blur ratio of Zhuo and Sim, "Defocus map estimation from a single image" (Pattern Recognition
2011), taken over all pixels of a tile and along directions. With T(sigma) the mean structure tensor of the
image smoothed by a Gaussian of standard deviation sigma, u' T(sigma) u is the energy of the derivative along
u. For content whose energy goes as sigma^-2p (p = 1/2 for step edges, 1 for fine texture) under a blur of
standard deviation s along u it goes as (sigma^2 + s^2)^-p. The ratio of the energies at two scales therefore
gives s whatever the contrast, once p is known, and p is what sharper views of the same content tell. A motion
of length L acts along its own direction only, where s = L / sqrt(12), while defocus acts along all.
"""

from __future__ import annotations

import cv2
import numpy as np

from cleargs.rva.luminance import Mask, Plane, away_from_masked
from cleargs.rva.scores import Floats

DIRECTIONS = 8
"""Directions over half a turn: a motion is at most 11 degrees away from one, where it keeps 98 % of its
length.
"""
FINE, COARSE = 1.0, 3.0
"""Standard deviations, px, of the two scales. Finer is noise; coarser mixes neighbouring edges."""
MAX_EXTENT = 6.0
"""Extents, px, beyond which the ratio of the two scales says nothing more."""

TILE = 40
"""px: parallax and roll blur a frame unevenly, so each tile is measured and each counts the same; over all
pixels at once the parts of strongest contrast would speak for the whole."""

_NOISE_GAIN = 0.2  # standard deviation of a derivative at sigma = 1 over that of white noise: 1 / sqrt(8 pi)
_MIN_ENERGY = 1.0  # squared levels a pixel, at the coarse scale: a tile with less has no structure
_MIN_VISIBLE_SHARE = 0.25  # of a tile's pixels; with fewer in view it is not measured
_MARGIN = 13  # px: the support of the coarse scale, four deviations and the difference


def detail_ratios(luminance: Plane, valid: Mask, noise: float) -> Floats:  # [h, w], [h, w] -> [DIRECTIONS]
    """Mean over the tiles of u' T(FINE) u / u' T(COARSE) u along each direction k pi / DIRECTIONS.

    The noise's own share is taken off; ``noise`` in levels of 255. About 3 for a sharp scene of step edges,
    up to 9 for fine texture, towards 1 the stronger the blur; 0 without structure along a direction: what
    cannot be seen to be sharp is not trusted.

    Failure modes: content that is soft by itself (shadows, clouds, out-of-focus background) reads as blur,
    which is what neighbouring frames of a video share, see `statistics`; dense noise or grain in the dark
    reads as detail where `degradations.noise_level` misses it.
    """
    inner = away_from_masked(valid, _MARGIN)
    share = _tile_means(inner.astype(np.float32))
    fine, coarse = (_directional_energy(luminance, inner, share, noise, sigma) for sigma in (FINE, COARSE))
    measured = (share > _MIN_VISIBLE_SHARE)[:, None] & (coarse > _MIN_ENERGY)
    ratio = np.clip(fine / np.where(measured, coarse, 1.0), 1.0, (COARSE / FINE) ** 2)
    counts = np.count_nonzero(measured, axis=0)
    return np.where(counts > 0, np.sum(ratio, axis=0, where=measured) / np.maximum(counts, 1), 0.0)


def _directional_energy(
    luminance: Plane, inner: Mask, share: Floats, noise: float, sigma: float
) -> Floats:  # [tiles, DIRECTIONS]
    """u' T(sigma) u of each tile, in squared levels a pixel."""
    smooth = cv2.GaussianBlur(luminance, (0, 0), sigma)
    x, y = (0.5 * cv2.Sobel(smooth, cv2.CV_32F, dx, 1 - dx, ksize=1) * inner for dx in (1, 0))
    xx, xy, yy = (
        _tile_means(a * b) / np.maximum(share, _MIN_VISIBLE_SHARE) for a, b in ((x, x), (x, y), (y, y))
    )
    white = (_NOISE_GAIN * noise / sigma**2) ** 2
    angle = np.pi * np.arange(DIRECTIONS) / DIRECTIONS
    cos, sin = np.cos(angle), np.sin(angle)
    return np.asarray(
        np.outer(xx - white, cos**2) + np.outer(2.0 * xy, cos * sin) + np.outer(yy - white, sin**2)
    )


def _tile_means(plane: Plane) -> Floats:  # [h, w] -> [tiles]
    height, width = plane.shape
    size = max(1, round(width / TILE)), max(1, round(height / TILE))
    return cv2.resize(plane, size, interpolation=cv2.INTER_AREA).astype(np.float64).ravel()


def extents_from_ratios(
    ratio: Floats,  # [...] as `detail_ratios`
    content: Floats,  # [...] > 1: what sharp views of the same content have
) -> Floats:  # [...] px, in [0, MAX_EXTENT]
    """Standard deviation s of the blur: solves ratio = ((COARSE^2 + s^2) / (FINE^2 + s^2))^p with the p that
    ``content`` has at s = 0."""
    p = np.log(content) / np.log(COARSE**2 / FINE**2)
    quotient = np.maximum(ratio, 1.0) ** (1.0 / p)
    square = (COARSE**2 - quotient * FINE**2) / np.maximum(quotient - 1.0, 1e-6)
    return np.asarray(np.sqrt(np.clip(square, 0.0, MAX_EXTENT**2)))
