"""Pairs of frames to match, and their matching by processes of one thread each.

Pairs are all with all, or neighbours and distant frames that look alike. That needs no vocabulary from
elsewhere: the words are clustered from the capture's own descriptors.

COLMAP's own threads do not always find the same matches: with two of them 2 of 76 runs over the same features
differed (pycolmap 4.2.1), with one none of 60. Each process works through its share of the pairs in a copy of
the database (``python -m cleargs.capture.matching``); what was matched is gathered in the end, or by the next
run when this one is killed.
"""

from __future__ import annotations

import sqlite3
import subprocess
import sys
import threading
from collections.abc import Callable, Collection, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, suppress
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cleargs.capture.child import reports_to_parent
from cleargs.capture.colmap import pycolmap
from cleargs.children import module_command

_PAIRS_PER_BLOCK = 200
"""COLMAP indexes the features of a frame anew in each block (a tenth of the time), and keeps nothing of one
that it did not finish."""


N_WORDS = 32
"""Words of the vocabulary: VLAD works with few."""

_SAMPLE = 20_000
_ROUNDS = 8
_MAX_IMAGES = 2**31 - 1
"""COLMAP numbers a pair of images by the id of the first, times this, plus that of the second."""


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


def match_pairs(
    database: Path,
    names: Sequence[str],
    pairs: Sequence[tuple[int, int]],
    seed: int,
    processes: int,
    done: Callable[[int], None],
) -> None:
    """Match and verify the pairs of frames (numbers in ``names``) that ``database`` has no matches of yet.

    Equal for any number of processes. ``done`` is told how many pairs are through, from any thread. Raises
    ChildProcessError when a process fails, sqlite3.DatabaseError when its matches cannot be gathered.
    """
    for leftover in sorted(database.parent.glob(f"{database.stem}-share*.db")):
        with suppress(sqlite3.DatabaseError):  # damaged by whatever killed it: matched again
            _gather(database, leftover)
        _remove(leftover)
    with pycolmap.Database.open(database) as opened:
        todo = [pair for pair in pairs if not opened.exists_matches(pair[0] + 1, pair[1] + 1)]
    through = len(pairs) - len(todo)
    done(through)
    counting = threading.Lock()

    def count(more: int) -> None:
        nonlocal through
        with counting:
            through += more
            done(through)

    size = max(1, -(-len(todo) // processes))
    shares: list[Path] = []
    for start in range(0, len(todo), size):
        shares.append(database.with_name(f"{database.stem}-share{len(shares)}.db"))
        with closing(sqlite3.connect(database)) as source, closing(sqlite3.connect(shares[-1])) as target:
            source.backup(target)
        lines = (f"{names[i]} {names[j]}\n" for i, j in todo[start : start + size])
        shares[-1].with_suffix(".txt").write_text("".join(lines), encoding="utf-8")
    with ThreadPoolExecutor(max(1, len(shares))) as pool:
        list(pool.map(lambda share: _in_a_process(share, seed, count), shares))
    for share in shares:
        _gather(database, share)
        _remove(share)


def _in_a_process(share: Path, seed: int, count: Callable[[int], None]) -> None:
    command = module_command("cleargs.capture.matching", str(share), str(seed))
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as child:
        assert child.stdout is not None
        for line in child.stdout:
            count(int(line))
        status = child.wait()
    if status != 0:
        raise ChildProcessError(f"a process that matches frames ended with {status}")


def _gather(database: Path, share: Path) -> None:
    """Copy the matches in ``share`` to ``database``. Raises sqlite3.DatabaseError, and copies none, where one
    cannot be read or the other not be written."""
    with closing(sqlite3.connect(database)) as opened:
        opened.execute("ATTACH ? AS share", (str(share),))
        if opened.execute("PRAGMA share.integrity_check").fetchone() != ("ok",):
            raise sqlite3.DatabaseError(f"{share} is damaged")
        for table in ("matches", "two_view_geometries"):
            opened.execute(f"INSERT OR IGNORE INTO {table} SELECT * FROM share.{table}")
        opened.commit()


def _remove(share: Path) -> None:
    for leftover in share.parent.glob(f"{share.stem}.*"):
        leftover.unlink()


def copy_without_features(database: Path, copy: Path, image_ids: Collection[int]) -> None:
    """Copy COLMAP's ``database`` but for the features of these images and their matches."""
    for leftover in copy.parent.glob(f"{copy.name}*"):
        leftover.unlink()
    listed = ", ".join(str(int(image_id)) for image_id in image_ids)
    with closing(sqlite3.connect(database)) as source, closing(sqlite3.connect(copy)) as target:
        source.backup(target)
        for table in ("keypoints", "descriptors"):
            target.execute(f"DELETE FROM {table} WHERE image_id IN ({listed})")
        for table in ("matches", "two_view_geometries"):
            target.execute(
                f"DELETE FROM {table} WHERE pair_id / {_MAX_IMAGES} IN ({listed}) "
                f"OR pair_id % {_MAX_IMAGES} IN ({listed})"
            )
        target.commit()


def why_missing(database: Path, missing: Collection[int]) -> dict[int, str]:
    """Why COLMAP gave none of the images of these ids a pose."""
    with pycolmap.Database.open(database) as opened:
        pair_ids, inliers = opened.read_two_view_geometry_num_inliers()
        features = {image_id: opened.num_keypoints_for_image(image_id) for image_id in missing}
    matched: set[int] = set()
    for pair_id, count in zip(pair_ids, inliers, strict=True):
        pair = pycolmap.pair_id_to_image_pair(pair_id)
        if count and any(image_id not in features for image_id in pair):
            matched.update(pair)
    return {
        image_id: "too few points in common with placed frames"
        if image_id in matched
        else "matches no placed frame"
        if count
        else "no features"
        for image_id, count in features.items()
    }


def main() -> None:
    """Match the pairs listed beside the database ``argv[1]``; after each block the number of its pairs is
    printed."""
    share, seed = Path(sys.argv[1]), int(sys.argv[2])
    reports = reports_to_parent()
    pairs = share.with_suffix(".txt").read_text(encoding="utf-8").splitlines()
    pycolmap.set_random_seed(seed)
    matching = pycolmap.FeatureMatchingOptions(num_threads=1, use_gpu=False)
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = seed
    pairing = pycolmap.ImportedPairingOptions(match_list_path=share.with_suffix(".block"))
    for start in range(0, len(pairs), _PAIRS_PER_BLOCK):
        block = pairs[start : start + _PAIRS_PER_BLOCK]
        Path(pairing.match_list_path).write_text("\n".join(block) + "\n", encoding="utf-8")
        pycolmap.match_image_pairs(share, matching, pairing, verification)
        print(len(block), file=reports)


if __name__ == "__main__":
    main()
