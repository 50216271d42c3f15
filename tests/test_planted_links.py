"""Links at paths that a command uses. ``make drill`` plants 1,000 links of all kinds, at all paths."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from planted_links import Planter, finished_run, packed_run, planted, toy_run


def test_links_at_the_upper_paths_of_a_run_lead_nowhere(tmp_path: Path) -> None:
    done = {str(path) for path, _ in planted(tmp_path, toy_run, ("link",), depth=2)}
    assert {".lock", "run.log", "run.toml", ".store/locks", ".store/work", ".store/square"} <= done


@pytest.mark.slow
@pytest.mark.parametrize("make", [finished_run, packed_run])
def test_links_at_the_first_paths_of_a_finished_run_lead_nowhere(
    tmp_path: Path, make: Callable[[Path], Planter]
) -> None:
    done = {str(path) for path, _ in planted(tmp_path, make, ("link",), 1)}
    assert {"ingest", "consolidate", "scene.ply", "report", "report.html"} <= done
    assert {"pack.json", "eval"} & done


def test_links_in_a_packed_run_are_not_read(tmp_path: Path) -> None:
    planter = packed_run(tmp_path)
    for name in ("pack.json", "scene.ply", "report/frames/000000-final.jpg", "report/scene.js"):
        assert planter.check(Path(name), "link")
