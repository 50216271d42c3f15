"""A comparison of two runs with names that could break its page."""

from __future__ import annotations

from pathlib import Path

from report_run import FinishedRun

from benchmarks.comparison.findings import Comparison, compare_scenes
from benchmarks.comparison.scenes import SceneRecipe, scene_of_run
from cleargs.digest import DigestMemo
from cleargs.evaluate.config import EvalOptions
from cleargs.pipeline.store import Store
from cleargs.progress import SilentReporter

HOSTILE = "<img src=x onerror='window.hacked = 1'>"
HELD_OUT = (1, 2, 4, 5)


def compare_runs(root: Path) -> tuple[Path, Comparison]:
    """Evaluate two runs of one capture on their held-out frames; also return the folder of the comparison."""
    runs = [FinishedRun(root, name, HELD_OUT) for name in (HOSTILE, "second")]
    (runs[1].folder / "consolidate/manifest.json").unlink()  # its scene is that of g0
    (runs[1].folder / "rivr/manifest.json").unlink()
    out = root / "out"
    out.mkdir()
    recipe = SceneRecipe(runs[0].dag, "default", (), "cpu", 1, EvalOptions(lpips=(), scorers=()))
    with DigestMemo(root / "digests.json") as memo:
        made = [scene_of_run(run.folder, run.dag, None) for run in runs]
        return out, compare_scenes(out, made, recipe, Store(root, memo), SilentReporter())
