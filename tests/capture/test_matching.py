"""Matching by processes: the same matches for any number of them, and nothing lost when they are killed."""

from __future__ import annotations

import os
import signal
import sqlite3
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing
from itertools import combinations
from pathlib import Path
from typing import Any

import pycolmap
import pytest

from cleargs.capture import matching
from cleargs.capture.matching import block_size, match_pairs

NAMES = [f"view{index}.png" for index in range(4)]
PAIRS = list(combinations(range(len(NAMES)), 2))


@pytest.fixture
def database(images: Path, tmp_path: Path) -> Path:
    """Features of four frames."""
    found = tmp_path / "database.db"
    options = pycolmap.FeatureExtractionOptions(num_threads=1, use_gpu=False)
    options.sift.max_num_features = 256
    pycolmap.extract_features(found, images, image_names=NAMES, extraction_options=options)
    return found


def matches(database: Path) -> list[Any]:
    with closing(sqlite3.connect(database)) as opened:
        return [
            row
            for table in ("matches", "two_view_geometries")
            for row in opened.execute(f"SELECT * FROM {table} ORDER BY pair_id")
        ]


def match(database: Path, processes: int) -> list[int]:
    through: list[int] = []
    match_pairs(database, NAMES, PAIRS, 0, processes, through.append)
    return through


def test_any_number_of_processes_finds_the_same(database: Path, tmp_path: Path) -> None:
    copy = tmp_path / "other.db"
    copy.write_bytes(database.read_bytes())
    assert match(database, 1) == [0, 6]
    assert match(copy, 4) == [0, 2, 4, 6]
    assert len(matches(database)) == 12 and matches(database) == matches(copy)
    assert sorted(path.name for path in tmp_path.glob("*share*")) == []


@pytest.mark.parametrize(
    ("pairs", "processes", "size"),
    [
        (1290, 2, 162),  # four blocks each; blocks of 200 would be four and three
        (1700, 8, 107),  # two blocks each; blocks of 200 would leave seven processes without a second one
        (400, 2, 200),
        (3, 8, 1),
        (0, 2, 1),
    ],
)
def test_processes_get_equally_many_blocks(pairs: int, processes: int, size: int) -> None:
    assert block_size(pairs, processes) == size


def test_matches_of_a_killed_run_are_gathered(database: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also with another number of processes; a damaged share alone is matched again."""
    whole = database.with_name("whole.db")
    whole.write_bytes(database.read_bytes())
    match(whole, 1)
    with monkeypatch.context() as patch:
        for last in ("_gather", "remove_database"):  # as if killed before the end
            patch.setattr(matching, last, lambda *_: None)
        match(database, 3)
    assert not matches(database)
    min(database.parent.glob("database-share*.db")).write_bytes(b"SQLite format 3\0 no longer")
    through = match(database, 2)
    assert through[0] < through[-1] == 6
    assert matches(database) == matches(whole)


def die(*_: object) -> int:
    os.kill(os.getpid(), signal.SIGKILL)
    return 0


def spoil(database: Path, seed: int, block: list[str]) -> int:
    database.with_name("database-share1.db").write_bytes(b"no database")
    return len(block)


def test_a_process_that_dies_is_told(database: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(matching, "_match_block", die)
    with pytest.raises(BrokenProcessPool):
        match(database, 1)


def test_matches_that_cannot_be_gathered_are_not_passed_over(
    database: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """For example a full disk: SfM with a part of the matches would be mistaken for complete."""
    monkeypatch.setattr(matching, "_match_block", spoil)
    with pytest.raises(sqlite3.DatabaseError):
        match(database, 1)
