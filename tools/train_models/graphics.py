"""Drawn training images: colour gradients and layered shapes, sharp and soft.

The photo sources contain few smooth areas (plain walls, skies, graphics). Without drawn images, the scorer
mistakes smoothness for blur and does not learn sharpening and ringing artefacts there.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from cleargs.types import ImageF32

_OVERSAMPLING = 2  # images are drawn larger and reduced, so that edges are as soft as those of a camera


def graphic(side: int, rng: np.random.Generator) -> ImageF32:
    """Draw a square image of ``side`` px: a gradient behind up to 40 shapes, and texture half of the time."""
    n = side * _OVERSAMPLING
    out = _shade(n, rng)
    for _ in range(int(rng.integers(1, 40))):
        out = out + _shape(n, rng) * (_shade(n, rng) - out)
    image = np.asarray(
        cv2.resize(np.clip(out, 0.0, 1.0), (side, side), interpolation=cv2.INTER_AREA), np.float32
    )
    if rng.random() < 0.5:
        white = rng.standard_normal((side, side)).astype(np.float32)
        grain = np.asarray(cv2.GaussianBlur(white, (0, 0), float(rng.uniform(0.5, 4.0))))[..., None]
        image = np.clip(image + np.float32(rng.uniform(0.0, 0.03)) * grain / grain.std(), 0.0, 1.0)
    return image


def _shade(n: int, rng: np.random.Generator) -> NDArray[np.float32]:
    """Return a linear gradient between random colours [n, n, 3]."""
    y, x = np.mgrid[0:n, 0:n].astype(np.float32)[..., None] / n
    colour, slope = rng.random(3), rng.normal(0.0, 0.25, (2, 3))
    return np.asarray(colour + x * slope[0] + y * slope[1], np.float32)


def _shape(n: int, rng: np.random.Generator) -> NDArray[np.float32]:
    """Return the opacity [n, n, 1] of an ellipse or polygon, often with a soft rim."""
    mask = np.zeros((n, n), np.float32)
    centre = rng.uniform(0, n, 2)
    radius = n * float(np.exp(rng.uniform(np.log(0.01), np.log(0.5))))
    if rng.random() < 0.5:
        axes = (2.0 * radius, 2.0 * radius * float(rng.uniform(0.1, 1.0)))
        box = ((float(centre[0]), float(centre[1])), axes, float(rng.uniform(0.0, 180.0)))
        cv2.ellipse(mask, box, 1.0, -1)
    else:
        corners = centre + radius * rng.normal(0.0, 1.0, (int(rng.integers(3, 7)), 2))
        cv2.fillPoly(mask, [corners.astype(np.int32)], 1.0)
    if rng.random() < 0.4:
        deviation = float(np.exp(rng.uniform(0.0, np.log(20.0))))
        mask = np.asarray(cv2.GaussianBlur(mask, (0, 0), deviation), np.float32)
    return np.asarray(mask[..., None] * rng.uniform(0.3, 1.0), np.float32)
