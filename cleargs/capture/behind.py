"""The still room behind things that turn before a camera that stands, as on a turntable."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from cleargs.media.image import image_size, read_rgb, reduced
from cleargs.types import ImageU8, MaskU8

_SAMPLES, _FEWEST = 32, 8  # maximum and minimum number of pictures that are compared
_COARSE = 240  # long side at which a still room is looked for, px
_SAME = 8.0
"""Largest difference of a still pixel from the median picture, levels."""
_SHOWN = 0.35
"""Minimum share of the pictures that show a pixel of the room: things that turn cover it in the others."""
_EDGE = 40.0  # Sobel response of the median picture, levels per pixel times 4, from which it has structure
_STANDS, _ROOM, _OF_EDGES, _TURNS = 0.9, 0.04, 0.25, 0.04
"""A room is still if edges that at least the first share of the pictures show cover the second share of the
pixels and the third of all edges of the median picture, and at least the last share of the pixels changes.
Observed: 0.17 and 0.58 of a turntable; at most 0.05 and 0.14 of eight frames of a walk that nearly rests."""
_REACH = 0.1  # distance between structures of the room, in long sides, up to which all between them is room
_RIM = 2  # px around the things that turn which still belong to them


@dataclass(frozen=True, eq=False)
class StillRoom:
    """The part of the pictures that stays in its place, while something before it turns."""

    picture: NDArray[np.float32]  # [H, W] grey
    region: NDArray[np.uint8]  # [H, W], 1 where the room is known
    share: float
    """Share of the pixels in the region."""

    def mask(self, rgb: ImageU8) -> MaskU8:  # [H, W, 3]
        """Return the mask of a picture: 0 where it shows the room, 255 elsewhere."""
        same = (np.abs(_smooth(rgb) - self.picture) <= _SAME).astype(np.uint8) & self.region
        same = cv2.medianBlur(same, 5)
        return np.where(cv2.erode(same, np.ones((2 * _RIM + 1,) * 2, np.uint8)) > 0, 0, 255).astype(np.uint8)


def still_room(images: Sequence[Path]) -> StillRoom | None:
    """Return the still room behind things that turn in ``images``; None without both, or for few images."""
    step = max(1, len(images) / _SAMPLES)
    paths = [images[int(index * step)] for index in range(min(len(images), _SAMPLES))]
    if len(paths) < _FEWEST or len({image_size(path) for path in paths}) > 1:
        return None
    if _room_of([reduced(read_rgb(path), _COARSE) for path in paths]) is None:
        return None
    return _room_of([read_rgb(path) for path in paths])


def _room_of(pictures: Sequence[ImageU8]) -> StillRoom | None:
    stack = np.stack([_smooth(rgb) for rgb in pictures])
    middle = np.median(stack, axis=0)
    shown = (np.abs(stack - middle) <= _SAME).mean(axis=0)
    slope = np.hypot(cv2.Sobel(middle, cv2.CV_32F, 1, 0), cv2.Sobel(middle, cv2.CV_32F, 0, 1))
    known = (shown >= _SHOWN).astype(np.uint8)
    structured = known & (slope >= _EDGE)
    size = max(middle.shape)
    edges, still = slope >= _EDGE, shown >= _STANDS
    standing = (edges & still).mean()
    stands = standing >= max(_ROOM, _OF_EDGES * edges.mean()) and (~still).mean() >= _TURNS
    if size <= _COARSE and not stands:
        return None
    reach = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * round(_REACH * size) + 1,) * 2)
    region = (
        np.asarray(cv2.morphologyEx(structured.astype(np.uint8), cv2.MORPH_CLOSE, reach), np.uint8) & known
    )
    return StillRoom(middle, region, float(region.mean()))


def _smooth(rgb: ImageU8) -> NDArray[np.float32]:
    """Return the grey picture, slightly smoothed: noise and the edges of blocks are not motion."""
    return np.asarray(cv2.GaussianBlur(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), (0, 0), 0.8), np.float32)
