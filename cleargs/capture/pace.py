"""Distance that the picture moves from frame to frame of a video, and frames that are even in it."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from cleargs.media.image import reduced
from cleargs.types import ArrayF64, ImageU8

_SIZE = 160  # long side at which frames are compared, px
_STEP = 0.04
"""Motion from the reference picture after which the next one becomes the reference, in long sides. A hand
that holds still moves less, back and forth, and this is not added up."""
_POINTS, _FEWEST = 120, 12  # corners that are followed, and minimum number of them
_UNEVEN = {0.5: 0.3, 0.1: 0.05}
"""Share of the mean step between chosen frames -> largest share of shorter steps in an even pace.
Handheld walks (kitchen, office, terrace) have at most 0.24 and 0.04."""

_SHAKE = 1.5
"""Largest step that counts, as a factor of the median step of frames that move.
A shake does not make a new view."""


class Pace:
    """Adds up the motion of a video's frames, which `add` receives in order."""

    def __init__(self) -> None:
        self._steps: list[float] = []
        self._reference: NDArray[np.uint8] = np.zeros((0, 0), np.uint8)
        self._corners = self._places = np.zeros((0, 1, 2), np.float32)
        self._moved = 0.0  # from the reference, long sides

    def add(self, grey: ImageU8) -> None:  # [H, W]
        """Follow the corners of the reference picture into ``grey``."""
        small = np.asarray(reduced(grey, _SIZE), np.uint8)
        size = max(small.shape)
        if small.shape != self._reference.shape or len(self._corners) < _FEWEST:
            self._steps.append(0.0 if not self._steps else np.nan)
            return self._refer(small)
        places, found, _ = cv2.calcOpticalFlowPyrLK(
            self._reference, small, self._corners, self._places.copy(), flags=cv2.OPTFLOW_USE_INITIAL_FLOW
        )
        kept = np.asarray(found).ravel() == 1
        if kept.sum() < max(_FEWEST, len(kept) // 2):  # another view: at least a step
            self._steps.append(_STEP)
            return self._refer(small)
        self._places = np.where(kept[:, None, None], places, self._corners)
        moved = float(np.median(np.linalg.norm((places - self._corners)[kept], axis=-1))) / size
        self._steps.append(max(0.0, moved - self._moved))
        self._moved = max(self._moved, moved)
        if moved >= _STEP:
            self._refer(small)

    def _refer(self, small: NDArray[np.uint8]) -> None:
        found = cv2.goodFeaturesToTrack(small, _POINTS, 0.01, 4)
        self._corners = np.zeros((0, 1, 2), np.float32) if found is None else np.asarray(found)
        self._reference, self._places, self._moved = small, self._corners, 0.0

    def distances(self) -> ArrayF64:
        """Return the distance [F] of each frame from the first, long sides. It never falls.

        Steps between plain pictures, which cannot be followed, count as the median of the others.
        """
        steps = np.array(self._steps)
        known = steps[np.isfinite(steps)]
        return np.cumsum(np.where(np.isfinite(steps), steps, np.median(known[1:]) if len(known) > 1 else 0.0))


def even_places(distances: ArrayF64, chosen: NDArray[np.intp]) -> NDArray[np.intp] | None:
    """Return the place [F] of each frame among as many stretches as there are frames ``chosen``.

    The stretches have the same length by ``distances`` [F]. Returns None if those between the frames
    ``chosen``, which are even in time, are much alike already, or if nothing moves.
    """
    moves = np.diff(distances, prepend=distances[:1])
    if moves.any():
        usual = np.median(moves[moves > 0.1 * moves.mean()])
        distances = np.cumsum(np.minimum(moves, _SHAKE * usual))
    steps, length = np.diff(distances[chosen]), float(distances[-1])
    even = all((steps < slow * steps.mean()).mean() <= most for slow, most in _UNEVEN.items())
    if len(steps) < 2 or length < 2 * _STEP or even:
        return None
    ends = (np.arange(len(chosen) - 1) + 0.5) / (len(chosen) - 1) * length
    return np.searchsorted(ends, distances)
