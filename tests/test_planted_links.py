"""A link at every path that a command uses; ``tests/planted_links.py`` plants more kinds of links."""

from __future__ import annotations

from pathlib import Path

import pytest
from planted_links import planted


@pytest.mark.parametrize("depth", [2, pytest.param(99, marks=pytest.mark.slow)])
def test_links_at_all_paths_of_a_run_lead_nowhere(tmp_path: Path, depth: int) -> None:
    done = {str(path) for path, _ in planted(tmp_path, ("link",), depth)}
    assert {".lock", "run.log", "run.toml", ".store/locks", ".store/work", ".store/square"} <= done
    assert depth == 2 or any(path.endswith("/checkpoints/state.txt") for path in done)
