"""``cleargs batch``: run all scenes of a sheet on this machine."""

from __future__ import annotations

from collections import Counter
from dataclasses import asdict
from pathlib import Path
from typing import Any

import click

from cleargs.batch.loop import Batch
from cleargs.batch.sheet import SceneJob, SheetError, read_scenes
from cleargs.batch.summary import SUMMARY, Result, write_summary
from cleargs.cli.common import (
    answer,
    fail_below_option,
    json_option,
    output_option,
    partial_option,
    quality_option,
    quiet_option,
    report_below,
    report_option,
    until_option,
    with_shortcuts,
    work_options,
)
from cleargs.cli.progress_bars import make_reporter
from cleargs.errors import CleargsError
from cleargs.pipeline.session import DeviceChoice, resolve_device
from cleargs.pipeline.stages import Stages
from cleargs.report.formatting import count, duration
from cleargs.types import Device


@click.command(
    epilog="""\b
Examples:
  cleargs batch captures.toml --dry-run          check the sheet; show hours, memory and disk
  cleargs batch captures.toml                    run the missing stages, scene by scene
  cleargs batch captures.csv --quality draft

To run scenes in parallel on a cluster, see docs/cluster.md.
"""
)
@click.argument("sheet", type=click.Path(dir_okay=False, path_type=Path))
@output_option(
    "Folder of the batch.  [default: SHEET with the ending .batch]", "folder", metavar="BATCH", required=False
)
@until_option
@quality_option
@click.option(
    "--dry-run", is_flag=True, help="Only check the sheet; show which stages would run, and the cost."
)
@click.option("--summary", is_flag=True, help="Run nothing; write summary and page of the present results.")
@fail_below_option("psnr_unseen, frames_placed ...")
@report_option("Write a report of each scene, and BATCH/report/index.html with links to them.")
@partial_option
@work_options
@json_option
@quiet_option
@click.pass_obj
def batch(
    dag: Stages,
    sheet: Path,
    folder: Path | None,
    until: str | None,
    quality: str | None,
    dry_run: bool,
    summary: bool,
    fail_below: dict[str, float],
    wants_report: bool,
    allow_partial: bool,
    device: DeviceChoice,
    threads: int,
    as_json: bool,
    quiet: bool,
) -> int:
    """Run each scene of SHEET (TOML or CSV), one after the other.

    If a scene fails, the others still run. The same command again runs only the stages that are missing.
    BATCH/summary.csv has one row per scene.
    """
    dag.until(until)
    reporter = make_reporter(quiet)
    looks_only = dry_run or summary  # possible on a login node, which may lack the device of the cluster
    options = (
        *([] if looks_only else ["--threads", str(threads)]),
        *(["--allow-partial"] if allow_partial else []),
        *([] if wants_report else ["--no-report"]),
    )
    resolved: Device = "cuda"
    if not (looks_only and device == "cuda"):
        resolved = resolve_device(device, reporter.info, test=not looks_only)
    settings = with_shortcuts((), {"quality": quality})
    root = (folder or sheet.with_suffix(".batch")).absolute()
    try:
        scenes = Batch(dag, root, read_scenes(sheet), resolved, until, settings, options)
        scenes.check(sheet)
    except SheetError as error:
        for problem in error.problems:
            click.echo(problem, err=True)
        raise
    if dry_run:
        _print_plans(scenes, as_json)
        return 0
    results: list[Result] = []
    if not summary and not (root / SUMMARY).exists():  # it marks the folder as that of a batch
        root.mkdir(parents=True, exist_ok=True)
        write_summary(root / SUMMARY, results)
    with reporter.task("scenes", len(scenes.scenes)) as task:
        for scene in scenes.scenes:
            if not summary:
                scenes.run(scene, reporter)
            results.append(result := scenes.result(scene))
            write_summary(root / SUMMARY, results)
            reporter.info(_line(result))
            task.advance()
    page = None
    if wants_report:
        from cleargs.batch.page import write_batch

        try:
            page = write_batch(scenes, results)
        except CleargsError as error:  # the scenes themselves may have succeeded
            reporter.warn(f"no report was written: {error}; {error.hint}")
    states = Counter(result.state for result in results)
    answer(
        as_json,
        [asdict(result) for result in results],
        *map(_line, results),
        ", ".join(f"{count} {state}" for state, count in states.items()),
        f"summary: {root / SUMMARY}",
        *([f"report: {page}"] if page else []),
    )
    numbers = ("frames", "frames_placed", "psnr_unseen", "minutes", "memory_gb", "disk_gb")
    figures = {result.scene: {name: getattr(result, name) for name in numbers} for result in results}
    below = report_below(figures, fail_below)
    return 1 if below or states["failed"] or states["waiting"] else 3 if states["partial"] else 0


def _line(result: Result) -> str:
    figures = [f"{value} {meaning}" for value, meaning in result.figures()]
    return f"{result.scene}: {', '.join([result.state, *figures, *filter(None, [result.cause])])}"


def _print_plans(batch: Batch, as_json: bool) -> None:
    """Print hours, memory and disk of the missing stages, per scene and in total."""
    plans = [_plan_json(batch, scene) for scene in batch.scenes]
    total = {name: sum(plan[name] for plan in plans) for name in ("hours", "memory_gb", "disk_gb")}
    total["memory_gb"] = max(plan["memory_gb"] for plan in plans)  # the scenes run one after the other
    lines = []
    for plan in [*plans, {"scene": "total", **total, "note": count(len(plans), "scene")}]:
        time = duration(3600 * plan["hours"])
        cost = f"{time}, {plan['memory_gb']:.1f} GB memory, {plan['disk_gb']:.2f} GB disk"
        lines.append(f"{plan['scene']}: {cost}; {plan['note']}")
    answer(as_json, {"folder": str(batch.folder), "device": batch.device, **total, "scenes": plans}, *lines)


def _plan_json(batch: Batch, scene: SceneJob) -> dict[str, Any]:
    try:
        worked = batch.stages(scene)
        plans = [plan for plan in batch.plan(scene) if plan.stage in worked]
        to_do = [plan.stage for plan in plans if plan.state != "done"]
        note = f"to do: {', '.join(to_do)}" if to_do else "done"
    except CleargsError as error:
        plans, to_do, note = [], list(batch.dag.until(batch.until)), f"cannot be planned: {error}"
    costs = [plan.estimate for plan in plans if plan.estimate is not None]
    return {
        "scene": scene.name,
        "hours": round(sum(cost.minutes for cost in costs) / 60, 3),
        "memory_gb": round(max((cost.memory_gb for cost in costs), default=0.0), 2),
        "disk_gb": round(sum(cost.disk_gb for cost in costs), 3),
        "to_do": to_do,
        "note": note,
        "command": batch.arguments(scene),
    }
