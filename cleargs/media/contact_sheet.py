"""Contact sheets: labelled images in rows."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np

from cleargs.media.image import to_uint8
from cleargs.types import AnyImage, ImageU8

_LABEL_HEIGHT = 22  # px
_GAP = 4  # px
_BACKGROUND = 24
_TEXT = (235, 235, 235)
_MARKED = (40, 120, 60)


class Tile(NamedTuple):
    """One image of a sheet with its label above it."""

    image: AnyImage | None
    """[H, W, 3] sRGB, floats in [0, 1] or bytes; None leaves the place empty."""
    label: str
    """ASCII text, cut off where it does not fit."""
    marked: bool = False
    """True: the label has a green background."""


def contact_sheet(rows: Sequence[Sequence[Tile]], *, tile_width: int = 480) -> ImageU8:  # [H, W, 3]
    """Return an image [H, W, 3] of the rows of tiles, each image resampled to ``tile_width`` px.

    There must be at least one tile.
    """
    lines = [[_cell(tile, tile_width) for tile in row] for row in rows]
    heights = [max(len(cell) for cell in line) + _GAP for line in lines]
    step = tile_width + _GAP
    sheet = np.full((sum(heights), max(map(len, lines)) * step - _GAP, 3), _BACKGROUND, np.uint8)
    for line, height, bottom in zip(lines, heights, np.cumsum(heights), strict=True):
        for column, cell in enumerate(line):
            sheet[bottom - height :, column * step :][: len(cell), :tile_width] = cell
    return sheet


def _cell(tile: Tile, width: int) -> ImageU8:
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
