"""What the tests of the programs that measure ClearGS borrow from the tests of ClearGS."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

sys.path += [str(Path(__file__).parents[1] / name) for name in ("report", "rva")]


@pytest.fixture(scope="session")
def browser() -> Iterator[Any]:
    from browser import chromium

    with chromium() as opened:
        yield opened
