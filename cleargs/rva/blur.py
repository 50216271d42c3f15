"""Blur from the widths of edges, direction by direction.

Source: the re-blur ratio of Zhuo and Sim, "Defocus map estimation from a single image" (Pattern Recognition
2011). A step edge under a blur of standard deviation s has, seen through a Gaussian of standard deviation
sigma, a peak gradient proportional to 1 / sqrt(sigma^2 + s^2). The ratio of the peaks at two scales therefore
gives s whatever the contrast of the edge. Here the derivative is taken along each of several directions: a
motion blur of length L acts along its own direction only, where s = L / sqrt(12), while defocus acts along
all.
"""

from __future__ import annotations

import math

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
EDGE_SHARE = 0.03
"""Share of the pixels, those of the largest derivative, that are taken for edges."""
LARGEST_EXTENT = 6.0
"""Extents, px, beyond which the ratio of the two scales says nothing more."""

_NOISE_GAIN = 0.2  # standard deviation of a derivative at sigma = 1 over that of white noise: 1 / sqrt(8 pi)
_NOISE_CLEARANCE = 4.0  # an edge stands this many standard deviations above the noise
_LEAST_EDGES = 50  # pixels; fewer do not make a median
_MARGIN = 9  # px: the support of the coarse scale


def derivatives(luminance: Plane, sigma: float) -> tuple[Plane, Plane]:  # [h, w] -> d/dx, d/dy [h, w]
    """Central differences of the image smoothed by a Gaussian of standard deviation ``sigma``."""
    smooth = cv2.GaussianBlur(luminance, (0, 0), sigma)
    return 0.5 * cv2.Sobel(smooth, cv2.CV_32F, 1, 0, ksize=1), 0.5 * cv2.Sobel(
        smooth, cv2.CV_32F, 0, 1, ksize=1
    )


def blur_extents(luminance: Plane, valid: Mask, noise: float) -> Floats:  # [h, w], [h, w] -> [DIRECTIONS] px
    """Standard deviation s of the blur along each direction k pi / DIRECTIONS, in [0, LARGEST_EXTENT] px.

    The median over the edges of a direction: those pixels whose derivative along it is among the largest
    EDGE_SHARE and clear of the noise. A direction without edges, or a frame without structure, gets
    LARGEST_EXTENT: what cannot be seen to be sharp is not trusted.

    Failure modes: content that is soft by itself (shadows, clouds, out-of-focus background) reads as blur,
    fine texture as sharper than a step (s = 0); both are what neighbouring frames of a video share, see
    `statistics`.
    """
    inner = away_from_masked(valid, _MARGIN)
    fine_x, fine_y = (plane[inner] for plane in derivatives(luminance, FINE))
    coarse_x, coarse_y = (plane[inner] for plane in derivatives(luminance, COARSE))
    extents = np.full(DIRECTIONS, LARGEST_EXTENT)
    edges = int(EDGE_SHARE * fine_x.size)
    if edges < _LEAST_EDGES:
        return extents
    for k in range(DIRECTIONS):
        cos, sin = np.float32(np.cos(np.pi * k / DIRECTIONS)), np.float32(np.sin(np.pi * k / DIRECTIONS))
        fine = np.abs(cos * fine_x + sin * fine_y)
        strongest = np.argpartition(fine, -edges)[-edges:]
        strongest = strongest[fine[strongest] > _NOISE_CLEARANCE * _NOISE_GAIN * noise]
        if len(strongest) >= _LEAST_EDGES:
            coarse = np.abs(cos * coarse_x[strongest] + sin * coarse_y[strongest])
            extents[k] = extent_from_ratio(float(np.median(fine[strongest] / np.maximum(coarse, 1e-3))))
    return extents


def extent_from_ratio(ratio: float) -> float:
    """Solve ratio^2 = (COARSE^2 + s^2) / (FINE^2 + s^2) for s, px, within [0, LARGEST_EXTENT]."""
    if ratio <= 1.0:
        return LARGEST_EXTENT
    square = (COARSE**2 - (ratio * FINE) ** 2) / (ratio**2 - 1.0)
    return min(math.sqrt(max(square, 0.0)), LARGEST_EXTENT)


def fine_detail(luminance: Plane, valid: Mask, noise: float) -> float:
    """Mean squared gradient at the fine scale over that at the coarse one, the noise's own share taken off.

    About 9 for fine texture, 3 for a scene of step edges, towards 1 the stronger the blur; 0 without
    structure. Unlike `blur_extents` it counts all pixels, so weak texture as well as the strongest edges.
    """
    inner = away_from_masked(valid, _MARGIN)
    if not inner.any():
        return 0.0
    fine, coarse = (
        float(
            sum(np.mean(np.square(plane[inner], dtype=np.float64)) for plane in derivatives(luminance, sigma))
        )
        for sigma in (FINE, COARSE)
    )
    white = 2.0 * (_NOISE_GAIN * noise) ** 2  # both components
    fine -= white / FINE**4
    coarse -= white / COARSE**4
    return max(fine, 0.0) / coarse if coarse > 1e-2 else 0.0
