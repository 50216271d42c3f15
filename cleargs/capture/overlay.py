"""Detection of pictures that do not just show the scene: burnt-in text, and panoramas of all directions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from cleargs.capture.borders import STILL, blurred_border, even_border
from cleargs.media.image import image_size, read_rgb
from cleargs.types import ArrayF32, MaskBool, MaskU8

_SAMPLES = 32  # number of pictures, evenly over the capture, that are compared

_FEWEST = 6
"""Minimum number of images. In fewer, too many pixels are equal by chance."""

_MOVES, _MOVES_WITHIN = 10.0, 5.0
"""Median standard deviation over a picture, or within a border, from which the camera moves."""
_EDGE = 40.0  # Sobel response of the mean picture, levels per pixel times 4, from which a pixel has structure

_SHARE = 0.002, 0.5
"""Limits of the share of still pixels with structure: less is chance, more means a still camera."""


@dataclass(frozen=True)
class NoScene:
    """Pixels [H, W] that show no scene in any picture."""

    border: MaskBool
    """Even or blurred areas around the picture."""
    still: MaskBool
    """Text, logos, and patterned bars."""

    @property
    def mask(self) -> MaskU8:
        """The pixels [H, W] as a mask: 0 if the pixel shows no scene, else 255."""
        return np.asarray(np.where(self.border | self.still, 0, 255), np.uint8)


def without_scene(images: Sequence[Path]) -> NoScene | None:
    """Return the pixels that do not show the scene in all ``images`` of a moving camera.

    Returns None without such pixels, for a still camera, for few images, and for images of several sizes.
    """
    step = max(1, len(images) / _SAMPLES)
    chosen = [images[int(index * step)] for index in range(min(len(images), _SAMPLES))]
    sizes = {image_size(path) for path in chosen}
    if len(chosen) < _FEWEST or len(sizes) > 1:
        return None
    stack = np.array([cv2.cvtColor(read_rgb(path), cv2.COLOR_RGB2GRAY) for path in chosen], np.uint8)
    total, squares = np.zeros((2, *stack.shape[1:]), np.float32)
    for grey in stack:
        cv2.accumulate(grey, total)
        cv2.accumulateSquare(grey, squares)
    mean = total / len(stack)
    deviation = np.sqrt(np.maximum(squares / len(stack) - mean * mean, 0))
    border = even_border(stack, deviation)
    if not border.any():
        border = blurred_border(stack)
    motion = np.median(deviation[~border])
    if motion < (_MOVES_WITHIN if border.any() else _MOVES):
        return None
    still = _still_parts(mean, deviation, border) if motion >= _MOVES else np.zeros_like(border)
    return NoScene(border, still) if border.any() or still.any() else None


def _still_parts(mean: ArrayF32, deviation: ArrayF32, border: MaskBool) -> MaskBool:  # [H, W]
    """Return the pixels outside the ``border`` that are equal in all pictures, by mean and deviation.

    Only pixels with structure count, as letters, logos and patterned bars have it: a clipped sky is equal in
    all images too, but belongs to the scene.
    """
    slope = np.hypot(cv2.Sobel(mean, cv2.CV_32F, 1, 0), cv2.Sobel(mean, cv2.CV_32F, 0, 1))
    still = np.asarray(cv2.dilate((deviation <= STILL).astype(np.uint8), np.ones((3, 3), np.uint8)))
    still[cv2.dilate(border.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0] = 0
    # A letter is the still pixels near its edges.
    edges = np.where(slope >= _EDGE, still, 0).astype(np.uint8)
    found = np.minimum(cv2.dilate(edges, np.ones((3, 3), np.uint8)), still)
    found = np.asarray(cv2.morphologyEx(found, cv2.MORPH_OPEN, np.ones((2, 2), np.uint8)))
    reach = max(3, round(0.01 * max(mean.shape)) | 1)
    if not _SHARE[0] <= float(found.mean()) <= _SHARE[1]:
        return np.zeros_like(border)
    grown = cv2.dilate(found, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (reach, reach)))
    return np.asarray(grown > 0)


def wraps_around(rgb: NDArray[np.uint8]) -> bool:  # [H, W, 3]
    """Return True if a picture twice as wide as high continues from its right edge to its left one.

    An equirectangular picture shows all directions, so that its edges are neighbours.
    """
    height, width = rgb.shape[:2]
    if abs(width - 2 * height) > 2:
        return False
    columns = rgb.astype(np.float32)
    across = float(np.abs(columns[:, 0] - columns[:, -1]).mean())
    adjacent = float(np.abs(np.diff(columns, axis=1)).mean())
    # Columns that are half a picture apart differ as unrelated ones do.
    apart = float(np.abs(columns[:, 0] - columns[:, width // 2]).mean())
    return across <= 3 * adjacent and across < 0.5 * apart
