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
    return np.concatenate([_padded(strip, strip.shape[0], width) for strip in strips])


def _row(tiles: Sequence[Tile], width: int) -> NDArray[np.uint8]:
    cells = [_cell(tile, width) for tile in tiles]
    height = max(cell.shape[0] for cell in cells)
    return np.concatenate([_padded(cell, height + _GAP, width + _GAP) for cell in cells], axis=1)[:, :-_GAP]


def _cell(tile: Tile, width: int) -> NDArray[np.uint8]:
    """The label above the image."""
    label = np.full((_LABEL_HEIGHT, width, 3), _MARKED if tile.marked else _BACKGROUND, np.uint8)
    cv2.putText(label, tile.label, (4, 15), cv2.FONT_HERSHEY_SIMPLEX, 0.45, _TEXT, 1, cv2.LINE_AA)
    if tile.image is None:
        return label
    image = to_uint8(tile.image)
    height = max(1, round(image.shape[0] * width / image.shape[1]))
    kernel = cv2.INTER_AREA if width < image.shape[1] else cv2.INTER_NEAREST
    return np.concatenate(
        [label, np.asarray(cv2.resize(image, (width, height), interpolation=kernel), np.uint8)]
    )


def _padded(image: NDArray[np.uint8], height: int, width: int) -> NDArray[np.uint8]:
    below, right = height - image.shape[0], width - image.shape[1]
    return np.pad(image, ((0, below), (0, right), (0, 0)), constant_values=_BACKGROUND)
