"""Batches of toy scenes: the stages of ``tests/pipeline/toy.py``, run by the real engine."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "pipeline"))  # toy.py

from toy_batch import ToyBatch, make_toy_batch

from cleargs.batch.snakemake import find_snakemake
from cleargs.errors import InputError


@pytest.fixture
def engine() -> None:
    """Skips the test where Snakemake is not installed."""
    try:
        find_snakemake()
    except InputError as error:
        pytest.skip(f"{error}: {error.hint}")


@pytest.fixture
def toy(tmp_path: Path) -> Iterator[ToyBatch]:
    batch = make_toy_batch(tmp_path)
    yield batch
    batch.end_engine()
