"""Which frames are matched with which: all with all, or neighbours and distant frames that look alike.

Needs no vocabulary from elsewhere: the words are clustered from the capture's own descriptors.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

N_WORDS = 32
"""Words of the vocabulary: VLAD works with few."""

_SAMPLE = 20_000
_ROUNDS = 8


def exhaustive_pairs(count: int) -> list[tuple[int, int]]:
    """Every pair (i, j) with i < j."""
    return [(i, j) for i in range(count) for j in range(i + 1, count)]


def sequential_pairs(count: int, overlap: int) -> list[tuple[int, int]]:
    """Each frame with its ``overlap`` next ones, and with those 2^k on for k < overlap (COLMAP's quadratic
    overlap), which bridges stretches too blurred to match."""
    steps = set(range(1, overlap + 1)) | {2**power for power in range(overlap)}
    return sorted((i, i + step) for i in range(count) for step in steps if i + step < count)


def loop_pairs(
    descriptors: Sequence[NDArray[np.uint8]],  # each [K, 128]
    candidates: int,
    min_gap: int,
    seed: int,
) -> list[tuple[int, int]]:
    """Each frame with the ``candidates`` frames at least ``min_gap`` away whose content is most alike.

    VLAD (Jégou et al. 2010): residuals to the nearest word, summed per word, signed square root, normalised.
    Word coordinates are kept whole, so that all large sums are of integers: exact in any order.
    """
    count = len(descriptors)
    if candidates == 0 or count <= min_gap or not any(len(rows) for rows in descriptors):
        return []
    words = _vocabulary(np.concatenate(list(descriptors)), seed)
    signatures = np.stack([_vlad(rows, words) for rows in descriptors])
    similarity = np.round(signatures @ signatures.T, 9)
    pairs: set[tuple[int, int]] = set()
    for i in range(count):
        # Stable, so that ties go to the earlier frame.
        far = [j for j in np.argsort(-similarity[i], kind="stable").tolist() if abs(i - j) >= min_gap]
        pairs.update((min(i, j), max(i, j)) for j in far[:candidates])
    return sorted(pairs)


def _vocabulary(rows: NDArray[np.uint8], seed: int) -> NDArray[np.float64]:  # [N_WORDS, 128]
    """k-means on a sample of descriptors, centres rounded to whole numbers."""
    random = np.random.default_rng(seed)
    sample = rows[random.permutation(len(rows))[:_SAMPLE]].astype(np.float64)
    words = sample[:N_WORDS].copy()
    for _ in range(_ROUNDS):
        nearest = _nearest(sample, words)
        for word in range(len(words)):
            members = sample[nearest == word]
            if len(members):
                words[word] = np.rint(members.sum(axis=0) / len(members))
    return words


def _nearest(rows: NDArray[np.float64], words: NDArray[np.float64]) -> NDArray[np.intp]:
    return np.asarray(np.argmin((words**2).sum(axis=1) - 2 * rows @ words.T, axis=1))


def _vlad(rows: NDArray[np.uint8], words: NDArray[np.float64]) -> NDArray[np.float64]:
    values = rows.astype(np.float64)
    nearest = _nearest(values, words)
    sums = np.zeros_like(words)
    for word in range(len(words)):
        sums[word] = (values[nearest == word] - words[word]).sum(axis=0)
    rooted = np.sign(sums) * np.sqrt(np.abs(sums))
    norm = float(np.linalg.norm(rooted))
    return (rooted / norm if norm > 0 else rooted).ravel()
