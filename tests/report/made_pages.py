"""A batch of hand-made runs, with names that try to break its page."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from report_run import FinishedRun

from cleargs.batch.loop import Batch
from cleargs.batch.page import write_batch
from cleargs.batch.sheet import SceneJob
from cleargs.digest import DigestMemo
from cleargs.pipeline.store import Store
from cleargs.report.page import write_report

CAUSE = "<script>window.hacked = 1</script> cannot be read"


def batch_page(root: Path) -> Path:
    """The page of three scenes: one done with a report, one waiting without a report, one failed."""
    folder = root / "captures & more.batch"
    attic = FinishedRun(folder / "scenes", "attic")
    with DigestMemo(root / "digests.json") as memo:
        write_report(attic.planner(Store(root, memo)))
    FinishedRun(folder / "scenes", "barn")
    (folder / "logs").mkdir()
    (folder / "logs" / "cellar.log").touch()
    scenes = [SceneJob(name, root / name, "smoke", (), name) for name in ("attic", "barn", "cellar")]
    batch = Batch(attic.dag, folder, scenes, "cpu")
    done, waiting, failed = (batch.result(scene) for scene in scenes)
    results = [
        replace(done, state="done", cause=""),
        replace(waiting, state="waiting", cause=""),
        replace(failed, state="failed", cause=CAUSE),
    ]
    return write_batch(batch, results)
