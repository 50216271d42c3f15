"""How much of an image there is to judge.

A no-reference scorer guesses the quality of what it sees. Where an image is flat, or clipped to black or
white, there is nothing to see: a guess made there stands on no evidence, and a black frame may well look
flawless. Such parts count as worth nothing: the score is multiplied by the share of the rest.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cleargs.models.tile_mean import Image

BLOCK = 16
"""Side of the blocks that are judged one by one, px."""

_STEPS = 255.0
"""Of an 8-bit image, in [0, 1]."""
_CLIPPED = 2.0  # steps from black or white up to which a value counts as clipped, in part
_ENOUGH = 0.5  # a block counts in full while so many of its values are not clipped: highlights are no fault
_FLAT, _TEXTURED = 0.5, 0.75  # steps of deviation inside a block; rounding alone makes up to 0.5


def information(image: Image) -> float:
    """The share of an image [H, W, 3], float32 sRGB in [0, 1], that is neither flat nor clipped: 0 to 1.

    Each block of 16 px counts by its values that are not clipped, in full from one half on, and by its
    contrast, in full from 3/4 of an 8-bit step of standard deviation on. All limits are ramps, so the
    share changes continuously with the image. It is close to 1 for
    ordinary frames (``weights/README.md`` has figures).
    """
    blocks = _blocks(image)
    to_the_end = np.minimum(blocks, 1.0 - blocks) * (_STEPS / _CLIPPED)
    unclipped = np.clip(to_the_end, 0.0, 1.0).mean(axis=(1, 3, 4))
    deviation = _STEPS * np.sqrt(blocks.var(axis=(1, 3)).mean(axis=2))
    texture = np.clip((deviation - _FLAT) / (_TEXTURED - _FLAT), 0.0, 1.0)
    return float((np.minimum(unclipped / _ENOUGH, 1.0) * texture).mean())


def _blocks(image: Image) -> NDArray[np.float64]:
    """The image in blocks [rows, 16, columns, 16, 3], mirrored where it does not fill the last."""
    height, width = image.shape[:2]
    padded = np.pad(image, ((0, -height % BLOCK), (0, -width % BLOCK), (0, 0)), mode="symmetric")
    rows, columns = padded.shape[0] // BLOCK, padded.shape[1] // BLOCK
    return padded.astype(np.float64).reshape(rows, BLOCK, columns, BLOCK, 3)
