"""Stages that are done only in part are published as partial and retried."""

from __future__ import annotations

from toy import Bench

from cleargs.manifest import read_manifest


def test_partial_stage_stops_the_run_and_is_retried(bench: Bench) -> None:
    (bench.capture / "2.txt").write_text("")
    outcomes = bench.run()
    assert [outcome.stage for outcome in outcomes] == ["count"]
    manifest = read_manifest(bench.folder / "count")
    assert manifest.status == "partial" and manifest.missing == ("2.txt is empty",)
    assert bench.plan()["count"].state == "partial"
    bench.work_done()

    bench.run()
    assert bench.work_done() == ["count"], "finished files are kept"
    assert not (bench.folder / "square").exists()


def test_status_is_inherited_with_allow_partial(bench: Bench) -> None:
    (bench.capture / "2.txt").write_text("")
    outcomes = bench.run(allow_partial=True)
    assert [outcome.manifest.status for outcome in outcomes] == ["partial"] * 3
    last = read_manifest(bench.folder / "total")
    assert last.missing == () and last.inherited == ("count: 2.txt is empty",)
    bench.work_done()
    bench.run(allow_partial=True)
    assert bench.work_done() == ["count"], "only the stage with something missing is tried again"


def test_complete_upstream_clears_the_inherited_status(bench: Bench) -> None:
    gone = bench.capture / "6.txt"
    gone.write_text("")
    assert bench.run(allow_partial=True)[-1].manifest.status == "partial"
    gone.unlink()
    bench.work_done()
    outcomes = bench.run()
    assert [outcome.manifest.status for outcome in outcomes] == ["complete"] * 3
    assert "square" not in bench.work_done()
    assert read_manifest(bench.folder / "square").status == "complete"


def test_partial_stage_becomes_complete(bench: Bench) -> None:
    """The stage fails for a reason outside its key, for example a broken device, and succeeds later."""
    stage = bench.dag.load("count")
    run = stage.run
    from cleargs.pipeline.stage import StageResult

    object.__setattr__(stage, "run", lambda context: StageResult(("it was dark",), run(context).summary))
    assert bench.run()[-1].manifest.missing == ("it was dark",)
    object.__setattr__(stage, "run", run)
    bench.work_done()
    assert [outcome.manifest.status for outcome in bench.run()] == ["complete"] * 3
    assert not [line for line in bench.work_done() if line.startswith("count ")], "nothing was counted again"
    assert bench.plan()["count"].state == "done"
