"""Few values in place of many: codebooks of numbers, palettes of vectors. Both come out the same every time."""

from __future__ import annotations

import heapq

import numpy as np
from numpy.typing import NDArray

_ROUNDS = 20  # of Lloyd's iteration; the mean square error falls by less than a hundredth after the tenth


def codebook(values: NDArray[np.float32], size: int) -> NDArray[np.float32]:  # any shape -> [size]
    """``size`` ascending numbers near which the ``values`` lie: one-dimensional k-means.

    It starts halfway between even steps of the range and even shares of the values, so that neither the
    crowd nor the outliers go without.
    """
    ordered = np.sort(values, axis=None).astype(np.float64)
    shares = np.linspace(0.0, 1.0, size)
    centres = (np.quantile(ordered, shares) + np.linspace(ordered[0], ordered[-1], size)) / 2
    sums = np.concatenate([[0.0], np.cumsum(ordered)])
    for _ in range(_ROUNDS):
        edges = [0, *np.searchsorted(ordered, (centres[1:] + centres[:-1]) / 2), len(ordered)]
        counts = np.diff(edges)
        centres = np.where(counts > 0, np.diff(sums[edges]) / np.maximum(counts, 1), centres)
    return centres.astype(np.float32)


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


def _spread(
    vectors: NDArray[np.float32], members: NDArray[np.int64], index: int
) -> tuple[float, int, int]:
    """For the heap: minus the sum of squared deviations of a group, its index, its widest axis."""
    squares = vectors[members].var(axis=0, dtype=np.float64) * len(members)
    return -float(squares.sum()), index, int(squares.argmax())
