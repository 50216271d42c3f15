"""An image-to-image function applied tile by tile, with overlap and blended seams.

The tile grid and the blend depend on the image size alone, and tiles are added up in a fixed order: the
result is bitwise the same for any number of threads.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import pairwise
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

Image: TypeAlias = NDArray[np.float32]

FREE_TILE = 512
"""Largest tile side in pixels where the model leaves it free."""

MULTIPLE = 64
"""Free tile sides are multiples of this, which suits encoders that halve the image up to six times."""


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
    return TileAxis(padded, size, starts, _windows(padded, size, starts))


def _windows(padded: int, size: int, starts: tuple[int, ...]) -> NDArray[np.float32]:
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


def apply_tiled(
    function: Callable[[Image], Image],
    image: Image,
    *,
    fixed: tuple[int | None, int | None] = (None, None),
    threads: int = 1,
    on_tile: Callable[[int, int], None] | None = None,
) -> Image:
    """The function's result on the whole image [H, W, 3], computed on tiles.

    function: maps a tile [h, w, 3] to one of the same shape; several threads may call it at once.
    threads: tiles computed at once.

    For the rest see `map_tiled`.
    """
    with ThreadPoolExecutor(max_workers=threads) as pool:
        return map_tiled(lambda tiles: pool.map(function, tiles), image, fixed=fixed, on_tile=on_tile)


def map_tiled(
    function: Callable[[Sequence[Image]], Iterable[Image]],
    image: Image,
    *,
    fixed: tuple[int | None, int | None] = (None, None),
    on_tile: Callable[[int, int], None] | None = None,
) -> Image:
    """The function's result on the whole image [H, W, 3], computed on tiles that it is given together.

    function: maps tiles [h, w, 3], all of one size, to as many of the same size, in their order.
    fixed: height and width of the tiles where the function accepts only these.
    on_tile: called with (done, total) after each tile, in the caller's thread.

    The image is padded by reflection at its right and bottom sides where it has to be.
    """
    height, width = image.shape[:2]
    rows, columns = plan_axis(height, fixed[0]), plan_axis(width, fixed[1])
    padding = ((0, rows.padded - height), (0, columns.padded - width), (0, 0))
    padded = np.pad(image, padding, mode="reflect")
    places = [(r, c) for r in range(len(rows.starts)) for c in range(len(columns.starts))]

    def cut(row: int, column: int) -> tuple[slice, slice]:
        y, x = rows.starts[row], columns.starts[column]
        return slice(y, y + rows.size), slice(x, x + columns.size)

    result = np.zeros_like(padded)
    tiles = function([padded[cut(*place)] for place in places])
    for done, ((row, column), tile) in enumerate(zip(places, tiles, strict=True), start=1):
        weight = rows.windows[row][:, None, None] * columns.windows[column][None, :, None]
        result[cut(row, column)] += weight * tile
        if on_tile is not None:
            on_tile(done, len(places))
    return np.ascontiguousarray(result[:height, :width])
