"""Application of networks to tiles of an image: to restore the image, or to compute one number.

The tiles and the blend weights depend only on the image size, and tiles are added in a fixed order. Results
are therefore the same bit for bit with any number of threads.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise, product
from typing import TypeAlias

import numpy as np

from cleargs.errors import InputError
from cleargs.types import AnyImage, ArrayF32, ImageF32

Sides: TypeAlias = tuple[int | None, int | None]
"""Height and width of the tiles; None: free."""

FREE_TILE = 512
"""Maximum side of a tile if the model does not fix it, px."""

MULTIPLE = 64
"""Divisor of free tile sides, for encoders that halve the image up to six times."""

MIN_SIDE = 32
"""Minimum side of an image that is scored, px. Below it AlexNet's third block has almost no pixels."""

_RANGE_TOLERANCE = 1e-3  # tolerance for values outside [0, 1]: the spacing of float16 values near 1


# -- image to image: overlapping tiles, blended --------------------------------------------------------------


@dataclass(frozen=True)
class TileAxis:
    """Tiles along one side of an image."""

    padded: int
    """Length of the side after padding, px."""
    size: int
    """Side of the tiles, px."""
    starts: tuple[int, ...]
    """First pixel of each tile."""
    windows: ArrayF32
    """Blend weights [tiles, size], which sum to 1 at each pixel."""


def plan_axis(length: int, fixed: int | None) -> TileAxis:
    """Return the tiles for a side of ``length`` pixels.

    Neighbours overlap by at least an eighth of the largest tile. Tiles of a ``fixed`` size are spread evenly.
    Free tiles are as small as the side allows, so that overlaps are small.
    """
    largest = fixed or FREE_TILE
    overlap = largest // 8
    step = 1 if fixed else MULTIPLE
    padded = max(math.ceil(length / step) * step, fixed or 0)
    count = max(1, math.ceil((padded - overlap) / (largest - overlap)))
    size = fixed or math.ceil((padded + (count - 1) * overlap) / count / step) * step
    # Starts are multiples of the step: the grid of the encoder is the same in all tiles, so neighbours agree.
    starts = tuple(round((padded - size) * k / max(count - 1, 1) / step) * step for k in range(count))
    return TileAxis(padded, size, starts, _blend_weights(padded, size, starts))


def _blend_weights(padded: int, size: int, starts: tuple[int, ...]) -> ArrayF32:
    """Return blend weights [tiles, size]: raised-cosine ramps in the overlaps, normalised to a sum of 1."""
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
    """Apply a function to overlapping tiles of an image [H, W, 3], and blend the results to one.

    ``function`` maps equal tiles [h, w, 3] to equal tiles, in their order. ``fixed`` is the tile size if the
    network needs one. The image is padded by reflection at the right and bottom if necessary.
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


# -- image to number: tiles that cover it --------------------------------------------------------------------


def require_scorable(image: AnyImage) -> None:
    """Raise InputError unless an image is [H, W, 3] float32 in [0, 1] with sides of at least 32 pixels.

    Scorers would return wrong scores for other types and ranges.
    """
    if image.ndim != 3 or image.shape[2] != 3 or min(image.shape[:2]) < MIN_SIDE:
        raise InputError(
            f"an image of shape {image.shape} cannot be scored",
            hint=f"give a [H, W, 3] image with at least {MIN_SIDE} pixels on each side",
        )
    if image.dtype != np.float32:
        raise InputError(
            f"an image of {image.dtype} values cannot be scored",
            hint="give float32 sRGB in [0, 1]; divide 8-bit values by 255",
        )
    low, high = float(image.min()), float(image.max())
    if not (low >= -_RANGE_TOLERANCE and high <= 1.0 + _RANGE_TOLERANCE):  # NaN fails both
        raise InputError(
            f"an image with values from {low:g} to {high:g} cannot be scored",
            hint="give finite sRGB values in [0, 1]",
        )


def mean_over_tiles(
    function: Callable[[Sequence[ImageF32]], Iterable[float]], image: ImageF32, sides: Sides
) -> float:
    """Return the mean of a function over evenly spaced tiles that cover an image [H, W, 3].

    ``function`` maps tiles [h, w, 3] of one size to one number each, in their order. A tile has these sides
    (None: the whole side), or less where the image is smaller. InputError is raised as by `require_scorable`.
    """
    require_scorable(image)
    places = []
    for length, side in zip(image.shape, sides, strict=False):
        tile = min(side or length, length)
        starts = np.linspace(0, length - tile, -(-length // tile)).round().astype(int).tolist()
        places.append([slice(start, start + tile) for start in starts])
    tiles = [image[place] for place in product(*places)]
    return float(np.mean(list(function(tiles)), dtype=np.float64))
