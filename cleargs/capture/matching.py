"""Pairs of frames to match, and their matching by single-threaded processes.

Pairs are all pairs, or neighbours and distant frames that look alike. No external vocabulary is needed: the
words are clustered from the capture's own descriptors.

COLMAP's threads do not always find the same matches (docs/experiments/poses.md). Each process matches blocks
of pairs in its own copy of the database. The matches are copied back at the end, or by the next run if this
one is killed.
"""

from __future__ import annotations

import math
import os
import sqlite3
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import closing, suppress
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from tempfile import NamedTemporaryFile

import numpy as np
from numpy.typing import NDArray

from cleargs.capture.colmap import pycolmap
from cleargs.capture.database import copy_database, is_sound, remove_database

_PAIRS_PER_BLOCK = 200
"""Maximum number of pairs per block. COLMAP indexes the features of a frame again in each block (a tenth of
the time), and keeps no matches of an unfinished block."""

N_WORDS = 32
"""Number of words in the vocabulary; VLAD needs only a few."""

_SAMPLE = 20_000
_ROUNDS = 8


def sequential_pairs(count: int, overlap: int) -> list[tuple[int, int]]:
    """Return each frame paired with its ``overlap`` next ones, and with those 2^k later for k < overlap.

    The latter (COLMAP's quadratic overlap) bridge stretches that are too blurred to match.
    """
    steps = set(range(1, overlap + 1)) | {2**power for power in range(overlap)}
    return sorted((i, i + step) for i in range(count) for step in steps if i + step < count)


def loop_pairs(
    descriptors: Sequence[NDArray[np.uint8]], candidates: int, min_gap: int, seed: int
) -> list[tuple[int, int]]:
    """Return each frame paired with the ``candidates`` most similar frames at least ``min_gap`` away.

    Each frame has descriptors [K, 128]. Similarity is that of VLAD signatures (Jégou et al. 2010): residuals
    to the nearest word, summed per word, signed square root, normalised. Word coordinates are integers, so
    that all large sums are exact in any order.
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
    """Return the centres of k-means on a sample of descriptors, rounded to whole numbers."""
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


def block_size(pairs: int, processes: int) -> int:
    """Return the number of pairs per block, so that all ``processes`` get equally many blocks."""
    rounds = max(1, math.ceil(pairs / (processes * _PAIRS_PER_BLOCK)))
    return max(1, math.ceil(pairs / (processes * rounds)))


def match_pairs(
    database: Path,
    names: Sequence[str],
    pairs: Sequence[tuple[int, int]],
    seed: int,
    processes: int,
    done: Callable[[int], None],
) -> None:
    """Match and verify the ``pairs`` of frame numbers that have no matches in ``database`` yet.

    The result is the same for any number of ``processes``. ``done`` receives the number of finished pairs.
    Raises BrokenProcessPool if a process died, and sqlite3.DatabaseError if its matches cannot be copied.
    """
    for leftover in _shares(database):
        # A copy that was damaged when its run was killed is ignored: its pairs are matched again.
        with suppress(sqlite3.DatabaseError):
            _gather(database, leftover)
        remove_database(leftover)
    with pycolmap.Database.open(database) as opened:
        todo = [pair for pair in pairs if not opened.exists_matches(pair[0] + 1, pair[1] + 1)]
    through = len(pairs) - len(todo)
    done(through)
    lines = [f"{names[i]} {names[j]}\n" for i, j in todo]
    size = block_size(len(todo), processes)
    blocks = [lines[start : start + size] for start in range(0, len(lines), size)]
    with ProcessPoolExecutor(processes, get_context("spawn")) as pool:
        for count in pool.map(partial(_match_block, database, seed), blocks):
            through += count
            done(through)
    for share in _shares(database):
        _gather(database, share)
        remove_database(share)


def _match_block(database: Path, seed: int, block: Sequence[str]) -> int:
    """Match pairs (lines of two names) in this process's copy of ``database``; return their number."""
    share = database.with_name(f"{database.stem}-share{os.getpid()}.db")
    if not share.exists():
        copy_database(database, share)
    pycolmap.set_random_seed(seed)
    matching = pycolmap.FeatureMatchingOptions(num_threads=1, use_gpu=False)
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = seed
    with NamedTemporaryFile("w", encoding="utf-8") as listed:
        listed.writelines(block)
        listed.flush()
        pairing = pycolmap.ImportedPairingOptions(match_list_path=listed.name)
        pycolmap.match_image_pairs(share, matching, pairing, verification)
    return len(block)


def _shares(database: Path) -> list[Path]:
    return sorted(database.parent.glob(f"{database.stem}-share*.db"))


def _gather(database: Path, share: Path) -> None:
    """Copy the matches in ``share`` to ``database``, or raise sqlite3.DatabaseError if it is damaged."""
    if not is_sound(share):
        raise sqlite3.DatabaseError(f"{share} is damaged")
    with closing(sqlite3.connect(database)) as opened:
        opened.execute("ATTACH ? AS share", (str(share),))
        for table in ("matches", "two_view_geometries"):
            opened.execute(f"INSERT OR IGNORE INTO {table} SELECT * FROM share.{table}")
        opened.commit()
