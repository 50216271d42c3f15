"""Contact sheets: labelled images in rows, for looking at."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from cleargs.media.image import to_uint8

_LABEL_HEIGHT = 22  # px
_GAP = 4  # px
_BACKGROUND = 24
_TEXT = (235, 235, 235)
_MARKED = (40, 120, 60)


@dataclass(frozen=True, eq=False)
class Tile:
    """One image of a sheet with its label above it."""

    image: NDArray[np.float32] | None
    """[H, W, 3] sRGB in [0, 1]; None leaves the place empty."""
    label: str
    """ASCII; what does not fit is cut off."""
    marked: bool = False
    """Whether the label stands on green."""


def contact_sheet(rows: Sequence[Sequence[Tile]], *, tile_width: int = 480) -> NDArray[np.uint8]:  # [H, W, 3]
    """The rows of tiles below one another, each image resampled to ``tile_width`` px. At least one tile."""
    strips = [_row(row, tile_width) for row in rows]
    width = max(strip.shape[1] for strip in strips)
    sheet = np.full((sum(strip.shape[0] for strip in strips), width, 3), _BACKGROUND, np.uint8)
    top = 0
    for strip in strips:
        sheet[top : top + strip.shape[0], : strip.shape[1]] = strip
        top += strip.shape[0]
    return sheet


def _row(tiles: Sequence[Tile], width: int) -> NDArray[np.uint8]:
    images = [None if tile.image is None else _resized(to_uint8(tile.image), width) for tile in tiles]
    height = max((image.shape[0] for image in images if image is not None), default=0)
    size = (_LABEL_HEIGHT + height + _GAP, len(tiles) * (width + _GAP) - _GAP, 3)
    strip = np.full(size, _BACKGROUND, np.uint8)
    for k, (tile, image) in enumerate(zip(tiles, images, strict=True)):
        left = k * (width + _GAP)
        label = np.full((_LABEL_HEIGHT, width, 3), _MARKED if tile.marked else _BACKGROUND, np.uint8)
        cv2.putText(label, tile.label, (4, 15), cv2.FONT_HERSHEY_SIMPLEX, 0.45, _TEXT, 1, cv2.LINE_AA)
        strip[:_LABEL_HEIGHT, left : left + width] = label
        if image is not None:
            strip[_LABEL_HEIGHT : _LABEL_HEIGHT + image.shape[0], left : left + width] = image
    return strip


def _resized(image: NDArray[np.uint8], width: int) -> NDArray[np.uint8]:
    height = max(1, round(image.shape[0] * width / image.shape[1]))
    kernel = cv2.INTER_AREA if width < image.shape[1] else cv2.INTER_NEAREST
    resized = cv2.resize(image, (width, height), interpolation=kernel)
    return resized.astype(np.uint8, copy=False)
