"""The mean of a figure over tiles that cover an image: how both embedded scorers see an image of any size."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from cleargs.errors import InputError

Image: TypeAlias = NDArray[np.float32]

MIN_SIDE = 32

_OUTSIDE = 1e-3
"""How far values may lie outside [0, 1], by rounding: half floats near 1 are so far apart."""


def require_scorable(image: NDArray[Any]) -> None:
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
    figure: Callable[[Image], float],
    image: Image,
    sides: tuple[int | None, int | None],
    threads: int = 1,
) -> float:
    """The mean of ``figure`` over evenly spaced tiles [h, w, 3] that together cover ``image`` [H, W, 3].

    ``sides`` are the height and width of a tile, None for the whole side; a smaller image is one tile in that
    direction. The mean is taken in the tiles' order, so it does not depend on ``threads``.
    Raises InputError as `cover` does.
    """
    tiles = cover(image, sides)
    if threads == 1 or len(tiles) == 1:
        figures = [figure(tile) for tile in tiles]
    else:
        with ThreadPoolExecutor(threads) as pool:
            figures = list(pool.map(figure, tiles))
    return float(np.mean(figures, dtype=np.float64))


def cover(image: Image, sides: tuple[int | None, int | None]) -> list[Image]:
    """The tiles, all of one size.

    Raises InputError as `require_scorable` does.
    """
    require_scorable(image)
    return [
        image[row, column]
        for row in _windows(image.shape[0], sides[0])
        for column in _windows(image.shape[1], sides[1])
    ]


def _windows(length: int, tile: int | None) -> list[slice]:
    if tile is None or length <= tile:
        return [slice(0, length)]
    count = -(-length // tile)
    starts = np.linspace(0, length - tile, count).round().astype(int).tolist()
    return [slice(start, start + tile) for start in starts]
