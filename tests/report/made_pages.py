"""A batch made by hand, with names that try to break its page."""

from __future__ import annotations

import shutil
from pathlib import Path

from report_run import FinishedRun

from cleargs.batch.folder import BatchFolder, Plan
from cleargs.batch.resources import Wanted, resources
from cleargs.batch.status import SceneState
from cleargs.digest import DigestMemo
from cleargs.pipeline.store import Store
from cleargs.report.batch_page import write_batch
from cleargs.report.page import write_report

CAUSE = "<script>window.hacked = 1</script> cannot be read"


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
