"""Pairs of frames are matched by processes of one thread each: ``python -m cleargs.capture.matching``.

COLMAP's own threads do not always find the same matches: with two of them 2 of 76 runs over the same features
differed (pycolmap 4.2.1), with one none of 60. Each process works through its share of the pairs in a copy of
the database; what was matched is gathered in the end, or by the next run when this one is killed.
"""

from __future__ import annotations

import sqlite3
import subprocess
import sys
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, suppress
from pathlib import Path

from cleargs.capture.child import reports_to_parent
from cleargs.capture.colmap import pycolmap
from cleargs.children import module_command

_PAIRS_PER_BLOCK = 200
"""COLMAP indexes the features of a frame anew in each block (a tenth of the time), and keeps nothing of one
that it did not finish."""


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
