"""A comparison and a batch made by hand, with names that try to break their pages."""

from __future__ import annotations

import shutil
from pathlib import Path

from report_run import FinishedRun

from cleargs.batch.folder import BatchFolder, Plan
from cleargs.batch.resources import Wanted, resources
from cleargs.batch.status import SceneState
from cleargs.evaluate.comparison import Recipe, existing
from cleargs.evaluate.comparison_findings import Compared, compare_scenes
from cleargs.evaluate.config import EvalOptions
from cleargs.pipeline.digest import DigestMemo
from cleargs.pipeline.store import Store
from cleargs.progress import SilentReporter
from cleargs.report.batch_page import write_batch
from cleargs.report.page import write_report

HOSTILE = "<img src=x onerror='window.hacked = 1'>"
CAUSE = "<script>window.hacked = 1</script> cannot be read"
HELD_OUT = (1, 2, 4, 5)


def compare_runs(root: Path) -> tuple[Path, Compared]:
    """Two runs of one capture, judged on the frames that they held out; the folder of the comparison."""
    runs = [FinishedRun(root, name, HELD_OUT) for name in (HOSTILE, "second")]
    (runs[1].folder / "consolidate/manifest.json").unlink()  # its scene is that of g0
    (runs[1].folder / "rivr/manifest.json").unlink()
    out = root / "out"
    out.mkdir()
    recipe = Recipe(runs[0].dag, "default", (), "cpu", 1, EvalOptions(lpips=(), scorers=()))
    with DigestMemo(root / "digests.sqlite") as memo:
        made = [existing(run.folder, run.dag, None) for run in runs]
        return out, compare_scenes(out, made, recipe, Store(root, memo), SilentReporter())


def batch_page(root: Path) -> Path:
    """The page of three scenes: done with a report, at work without one, failed."""
    folder = BatchFolder(root / "captures & more.batch")
    run = FinishedRun(folder.root / "scenes", "attic")
    with DigestMemo(root / "digests.sqlite") as memo:
        write_report(run.planner(Store(root, memo)))
    barn = shutil.copytree(run.folder, folder.run("barn"), ignore=shutil.ignore_patterns("report"))
    shutil.rmtree(barn / "consolidate")
    log = folder.log("cellar", "ingest")
    log.parent.mkdir(parents=True)
    log.touch()
    stages = {stage: tuple(run.dag.load(stage).INPUTS) for stage in run.dag.names}
    asked = {stage: resources(stage, None, Wanted(), "cpu") for stage in stages}
    plan = Plan(
        watcher=(),
        program=(),
        options=(),
        stages=stages,
        until="consolidate",
        report=True,
        scenes=dict.fromkeys(("attic", "barn", "cellar"), asked),
    )
    states = [
        SceneState("attic", "done", "consolidate", 5),
        SceneState("barn", "running", "consolidate", 4, where="node7, job 12"),
        SceneState("cellar", "failed", "ingest", 0, CAUSE, log=log),
    ]
    return write_batch(folder, plan, states)
