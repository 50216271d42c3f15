"""Batches of toy scenes."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "pipeline"))  # toy.py

from toy_batch import SCENES, ToyBatch

from cleargs.batch import loop


@pytest.fixture
def toys(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> ToyBatch:
    for tens, scene in enumerate(SCENES):
        (tmp_path / scene).mkdir()
        for number in range(10 * tens, 10 * tens + 6):
            (tmp_path / scene / f"{number}.txt").write_text(str(number))
    (tmp_path / "empty.toml").touch()
    batch = ToyBatch(tmp_path)
    batch.write_sheet()
    monkeypatch.setattr(loop, "program", lambda: batch.program)
    return batch
