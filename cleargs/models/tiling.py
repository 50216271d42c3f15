"""Images of any size, tile by tile: to an image of the same size, or to one figure.

The tile grid and the blend depend on the image size alone, and tiles are added up in a fixed order: the
result is bitwise the same for any number of threads.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise, product
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from cleargs.errors import InputError
from cleargs.types import AnyImage, ImageF32

Sides: TypeAlias = tuple[int | None, int | None]
"""Height and width of the tiles, None where they are free."""

FREE_TILE = 512
"""Largest tile side in pixels where the model leaves it free."""

MULTIPLE = 64
"""Free tile sides are multiples of this, which suits encoders that halve the image up to six times."""

MIN_SIDE = 32
"""Shortest side of an image that is scored, px; below it AlexNet's third block has hardly a pixel left."""

_OUTSIDE = 1e-3
"""How far values may lie outside [0, 1], by rounding: half floats near 1 are so far apart."""


# -- image to image: overlapping tiles, blended --------------------------------------------------------------


@dataclass(frozen=True)
class TileAxis:
    """Tiles along one image side.

    padded: length in pixels after padding; size: side of every tile; starts: first pixel of each tile;
    windows: blend weights [tiles, size], which sum to one at every pixel.
    """

    padded: int
    size: int
    starts: tuple[int, ...]
    windows: NDArray[np.float32]


def plan_axis(length: int, fixed: int | None) -> TileAxis:
    """Tiles for an image side of ``length`` pixels.

    Neighbours overlap by at least an eighth of the largest tile. Tiles of a fixed size spread evenly; free
    ones shrink so that little is computed twice.
    """
    largest = fixed or FREE_TILE
    overlap = largest // 8
    step = 1 if fixed else MULTIPLE
    padded = max(math.ceil(length / step) * step, fixed or 0)
    count = max(1, math.ceil((padded - overlap) / (largest - overlap)))
    size = fixed or math.ceil((padded + (count - 1) * overlap) / count / step) * step
    # Starts on the multiple keep the encoder's grid the same in all tiles, so that neighbours agree.
    starts = tuple(round((padded - size) * k / max(count - 1, 1) / step) * step for k in range(count))
    return TileAxis(padded, size, starts, _blend_weights(padded, size, starts))


def _blend_weights(padded: int, size: int, starts: tuple[int, ...]) -> NDArray[np.float32]:
    """Blend weights [tiles, size]: raised-cosine ramps where neighbours overlap, normalised to sum to one."""
    windows = np.ones((len(starts), size), np.float64)
    for k, (left, right) in enumerate(pairwise(starts)):
        overlap = left + size - right
        ramp = np.sin(0.5 * np.pi * (np.arange(overlap) + 0.5) / overlap) ** 2
        windows[k, size - overlap :] *= ramp[::-1]
        windows[k + 1, :overlap] *= ramp
    total = np.zeros(padded)
    for start, window in zip(starts, windows, strict=True):
        total[start : start + size] += window
    for start, window in zip(starts, windows, strict=True):
        window /= total[start : start + size]
    return windows.astype(np.float32)


def map_tiled(
    function: Callable[[Sequence[ImageF32]], Iterable[ImageF32]],
    image: ImageF32,
    *,
    fixed: Sides = (None, None),
) -> ImageF32:
    """The function's result on the whole image [H, W, 3], computed on tiles that it is given together.

    function: maps tiles [h, w, 3], all of one size, to as many of the same size, in their order.
    fixed: height and width of the tiles where the function accepts only these.

    The image is padded by reflection at its right and bottom sides where it has to be.
    """
    height, width = image.shape[:2]
    rows, columns = plan_axis(height, fixed[0]), plan_axis(width, fixed[1])
    padding = ((0, rows.padded - height), (0, columns.padded - width), (0, 0))
    padded = np.pad(image, padding, mode="reflect")
    places = [
        (
            (slice(y, y + rows.size), slice(x, x + columns.size)),
            rows.windows[row][:, None, None] * columns.windows[column][None, :, None],
        )
        for row, y in enumerate(rows.starts)
        for column, x in enumerate(columns.starts)
    ]
    result = np.zeros_like(padded)
    tiles = function([padded[place] for place, _ in places])
    for (place, weight), tile in zip(places, tiles, strict=True):
        result[place] += weight * tile
    return np.ascontiguousarray(result[:height, :width])


# -- image to figure: tiles that cover it --------------------------------------------------------------------


def require_scorable(image: AnyImage) -> None:
    """Raise InputError for anything but [H, W, 3] float32 in [0, 1] of at least 32 pixels on each side.

    A scorer would give other types and ranges a score too, a wrong one.
    """
    if image.ndim != 3 or image.shape[2] != 3 or min(image.shape[:2]) < MIN_SIDE:
        raise InputError(
            f"an image of shape {image.shape} cannot be scored",
            hint=f"scorers take [H, W, 3] images of at least {MIN_SIDE} pixels on each side",
        )
    if image.dtype != np.float32:
        raise InputError(
            f"an image of {image.dtype} values cannot be scored",
            hint="scorers take float32 sRGB in [0, 1]; divide 8-bit values by 255",
        )
    low, high = float(image.min()), float(image.max())
    if not (low >= -_OUTSIDE and high <= 1.0 + _OUTSIDE):  # NaN fails both
        raise InputError(
            f"an image with values from {low:g} to {high:g} cannot be scored",
            hint="scorers take finite sRGB values in [0, 1]",
        )


def mean_over_tiles(
    figures: Callable[[Sequence[ImageF32]], Iterable[float]], image: ImageF32, sides: Sides
) -> float:
    """The mean of a figure over evenly spaced tiles [h, w, 3] that together cover ``image`` [H, W, 3].

    figures: maps tiles, all of one size, to one figure for each, in their order.
    sides: height and width of a tile, None for the whole side; a smaller image is one tile in that direction.

    Raises InputError as `require_scorable` does.
    """
    require_scorable(image)
    places = []
    for length, side in zip(image.shape, sides, strict=False):
        tile = min(side or length, length)
        starts = np.linspace(0, length - tile, -(-length // tile)).round().astype(int).tolist()
        places.append([slice(start, start + tile) for start in starts])
    tiles = [image[place] for place in product(*places)]
    return float(np.mean(list(figures(tiles)), dtype=np.float64))
