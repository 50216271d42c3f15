"""``cleargs run``, ``stage`` and ``status``: run the stages of a run, or show their state."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from shlex import quote
from typing import Any

import click

from cleargs.cli.common import (
    DONE_IN_PART,
    answer,
    json_option,
    manifest_json,
    output_option,
    partial_option,
    print_json,
    quality_option,
    quiet_option,
    report_option,
    run_argument,
    store_option,
    work_options,
)
from cleargs.cli.progress_bars import make_reporter
from cleargs.cli.report import outdated_report_note, write_run_report
from cleargs.pipeline.dag import Dag
from cleargs.pipeline.plan import Planner, StagePlan, cost_line
from cleargs.pipeline.run_file import read_run_file
from cleargs.pipeline.runner import Runner, StageOutcome, check_same_input
from cleargs.pipeline.session import DeviceChoice, opened_store, resolve_device, resolve_run, usable_cores
from cleargs.report.formatting import duration
from cleargs.safe_io import printable

Summaries = Mapping[str, Mapping[str, Any]]
"""Stage -> figures in its manifest."""

PICTURES = ("before_after.png", "candidates.png")
"""Pictures of a stage to look at after a run; the first that exists is named."""


@click.command(
    epilog="""\b
Examples:
  cleargs run video.mp4 -o room
  cleargs run video.mp4 -o room --start 3 --end 40        a part of it, in seconds
  cleargs run photos/ -o room --workflow smoke            a quick test
  cleargs run photos/ -o room --quality draft             a first impression with fewer and smaller frames
  cleargs run photos/ -o room --set ingest.max_frames=60 --set rva.tau_R=0.7
  cleargs run photos/ -o room --dry-run                   the stages that would run, why, and the cost
  cleargs run photos/ -o room --until rva                 stop before training
  cleargs run photos/ -o room --reset                     go back to the settings of the recipe
"""
)
@click.argument("source", metavar="INPUT", type=click.Path(path_type=Path))
@output_option("The run folder. An existing run is resumed.", "folder", metavar="RUN")
@click.option(
    "--workflow",
    metavar="NAME|FILE.toml",
    help="The recipe: default, smoke, paper, paper-open, or your TOML file.  [default: default; an existing "
    "run keeps its settings]",
)
@click.option(
    "--set",
    "overrides",
    multiple=True,
    metavar="STAGE.FIELD=VALUE",
    help="Change one setting. `cleargs settings` lists them.",
)
@quality_option
@click.option(
    "--start",
    type=click.FloatRange(min=0),
    metavar="S",
    help="Take a video from this second on (ingest.start).",
)
@click.option(
    "--end",
    type=click.FloatRange(min=0, min_open=True),
    metavar="S",
    help="Take a video up to this second (ingest.end).",
)
@click.option("--seed", type=click.IntRange(min=0), help="Seed of all random numbers.  [default: 0]")
@click.option("--reset", is_flag=True, help="Replace the settings of an existing run by those of the recipe.")
@click.option("--until", metavar="STAGE", help="The last stage to run.")
@click.option("--force", multiple=True, metavar="STAGE", help="Run this stage even if its results exist.")
@report_option("Write RUN/report/index.html at the end, as `cleargs report` does.")
@click.option("--dry-run", is_flag=True, help="Only show which stages would run, why, and the cost.")
@partial_option
@work_options
@store_option
@json_option
@quiet_option
@click.pass_obj
def run(
    dag: Dag,
    source: Path,
    folder: Path,
    workflow: str | None,
    overrides: tuple[str, ...],
    quality: tuple[str, ...],
    start: float | None,
    end: float | None,
    seed: int | None,
    reset: bool,
    until: str | None,
    force: tuple[str, ...],
    wants_report: bool,
    dry_run: bool,
    allow_partial: bool,
    device: DeviceChoice,
    threads: int,
    store: Path | None,
    as_json: bool,
    quiet: bool,
) -> int:
    """Turn INPUT into a clean scene in the folder RUN.

    INPUT is a video, a folder of videos or of images, a COLMAP project (images/ and sparse/0), or a folder
    with transforms.json or poses_bounds.npy. Existing results are reused, and an interrupted run resumes. An
    existing run keeps its settings (RUN/run.toml). Change them with --set, --workflow or --reset.
    """
    dag.until(until)
    reporter = make_reporter(quiet)
    settings = resolve_run(
        dag,
        source,
        folder,
        workflow=workflow,
        overrides=(*quality, *_stretch(start, end), *overrides),
        seed=seed,
        reset=reset,
        store=store,
        device=device,
        test_gpu=not dry_run,
        say=reporter.info,
    )
    with opened_store(settings.store) as opened:
        check_same_input(settings, dag, opened)
        if dry_run:
            planner = Planner(dag, settings, opened, threads, reporter)
            print_plans(planner.plan(until, tuple(dag.check(name) for name in force)), as_json)
            return 0
        runner = Runner(dag, settings, opened, threads, reporter)
        outcomes = runner.run_until(until, force=force, allow_partial=allow_partial)
        page = write_run_report(runner.planner, outcomes) if wants_report else None
        if not wants_report and (line := outdated_report_note(settings.folder, dag)):
            reporter.info(line)
    if as_json:
        print_json([outcome_json(outcome) for outcome in outcomes])
    else:
        print_outcomes(outcomes, settings.folder, page)
    return exit_code(outcomes)


def _stretch(start: float | None, end: float | None) -> list[str]:
    """Return the settings of the options ``--start`` and ``--end``."""
    values = {"ingest.start": start, "ingest.end": end}
    return [f"{name}={value}" for name, value in values.items() if value is not None]


@click.command(
    epilog="""\b
Example:
  cleargs run photos/ -o room --until ingest
  cleargs stage rva room
"""
)
@click.argument("name")
@run_argument
@click.option("--force", is_flag=True, help="Run the stage even if its results exist.")
@click.option("--report", "wants_report", is_flag=True, help="Write RUN/report/index.html at the end.")
@partial_option
@work_options
@store_option
@json_option
@quiet_option
@click.pass_obj
def stage(
    dag: Dag,
    name: str,
    run: Path,
    force: bool,
    wants_report: bool,
    allow_partial: bool,
    device: DeviceChoice,
    threads: int,
    store: Path | None,
    as_json: bool,
    quiet: bool,
) -> int:
    """Run the stage NAME of RUN with the settings in RUN/run.toml.

    All stages before it must be done.
    """
    dag.check(name)
    resolved = None if device == "auto" else resolve_device(device, click.echo)
    settings = read_run_file(run, dag, store=store, device=resolved)
    with opened_store(settings.store) as opened:
        runner = Runner(dag, settings, opened, threads, make_reporter(quiet))
        outcome = runner.run_stage(name, force=force, allow_partial=allow_partial)
        if wants_report:
            write_run_report(runner.planner, [outcome])
    if as_json:
        print_json(outcome_json(outcome))
    else:
        print_outcomes([outcome], settings.folder)
    return exit_code([outcome])


@click.command(
    epilog="""\b
States:
  done     all results exist
  partial  some results are missing; the next run retries them
  missing  no results for the current settings and inputs; the line shows what changed
"""
)
@run_argument
@store_option
@json_option
@click.pass_obj
def status(dag: Dag, run: Path, store: Path | None, as_json: bool) -> None:
    """Show for each stage of RUN if it is done, partial or missing, and what changed."""
    settings = read_run_file(run, dag, store=store)
    with opened_store(settings.store) as opened:
        planner = Planner(dag, settings, opened, usable_cores(), make_reporter())
        print_plans(planner.plan(), as_json)


# -- outcomes and plans -------------------------------------------------------------------------------------


def exit_code(outcomes: Sequence[StageOutcome]) -> int:
    """Return 0, or 3 if something is missing."""
    return DONE_IN_PART if any(outcome.manifest.status == "partial" for outcome in outcomes) else 0


def print_outcomes(outcomes: Sequence[StageOutcome], run: Path, report: Path | None = None) -> None:
    """Print missing outputs on stderr, then at most five lines on stdout.

    The lines name the result, its quality, the time, the ``report`` and a picture, and the next command.
    """
    last = outcomes[-1].manifest
    for missing in (*last.inherited, *(f"{last.stage}: {line}" for line in last.missing)):
        click.echo(f"missing: {printable(missing)}", err=True)
    if last.status == "partial":
        click.echo(
            "hint: give the same command again to retry, or --allow-partial to go on without it", err=True
        )
    summaries = {outcome.stage: outcome.manifest.summary for outcome in outcomes}
    scene = "scene.ply" in last.files
    partial = ", in part" if last.status == "partial" else ""
    place = run / last.stage / ("scene.ply" if scene else "")
    click.echo(f"{'scene' if scene else 'results'}: {place}{partial}{_extent(summaries)}")
    if quality := _quality(summaries):
        click.echo(f"quality: {quality}")
    click.echo(f"time: {_times(outcomes)}")
    pictures = [
        run / outcome.stage / name
        for outcome in reversed(outcomes)
        for name in PICTURES
        if name in outcome.manifest.files
    ]
    if shown := [*([report] if report else []), *pictures[:1]]:
        click.echo(f"look at: {', '.join(map(str, shown))}")
    click.echo(f"next: {_next(summaries, run, scene)}")


def _extent(summaries: Summaries) -> str:
    """Return the numbers of placed, strong and repaired frames, as far as they are known."""
    ingest, consolidate = summaries.get("ingest", {}), summaries.get("consolidate", {})
    words = []
    if "registered" in ingest and "frames" in ingest:
        words.append(f"{ingest['registered']} of {ingest['frames']} frames placed")
    if "roles" in summaries.get("rva", {}):
        words.append(f"{summaries['rva']['roles']['strong']} strong")
    if "repairs" in consolidate:
        words.append(f"{consolidate['repairs']} repaired")
    return f" ({', '.join(words)})" if words else ""


def _quality(summaries: Summaries) -> str:
    """Return the quality of the last scene; "" if it is unknown."""
    scenes = {
        stage: figures for stage, figures in summaries.items() if figures.get("psnr_unseen") is not None
    }
    if not scenes:
        return ""
    last, figures = list(scenes.items())[-1]
    first = summaries.get("g0", {}).get("psnr_unseen")  # not with `cleargs stage`
    compared = f" (first scene {first:.1f})" if last != "g0" and first is not None else ""
    text = (
        f"PSNR {figures['psnr_unseen']:.1f} dB{compared} on pixels that no training saw; "
        "views off the camera path are worse"
    )
    harm = figures.get("held_back", {}).get("harm")
    return f"{text}. Rejected: {harm}" if harm else text


def _times(outcomes: Sequence[StageOutcome]) -> str:
    """Return the time that this call took per stage, and the stages whose results it found."""
    made = [outcome for outcome in outcomes if outcome.how == "made"]
    found = [outcome.stage for outcome in outcomes if outcome.how == "found"]
    words = []
    if made:
        stages = ", ".join(f"{outcome.stage} {duration(outcome.manifest.seconds)}" for outcome in made)
        words.append(f"{duration(sum(outcome.manifest.seconds for outcome in made))} ({stages})")
        if (compiling := sum(outcome.manifest.compile_seconds for outcome in made)) >= 1.0:
            words.append(f"{duration(compiling)} for compiling kernels, once on this machine")
    if found:
        words.append(f"reused: {', '.join(found)}")
    return "; ".join(words)


def _next(summaries: Summaries, run: Path, scene: bool) -> str:
    """Return the command that the user may want next."""
    if not scene:
        stage = " rva" if list(summaries)[-1] == "rva" else ""
        return f"cleargs show {quote(str(run))}{stage}"
    if summaries.get("ingest", {}).get("test"):
        return f"cleargs eval {quote(str(run))}"
    return f"cleargs export {quote(str(run))} -o {quote(f'{run.name}.ply')}"


def outcome_json(outcome: StageOutcome) -> dict[str, Any]:
    """Return an outcome as JSON values."""
    facts = {"stage": outcome.stage, "how": outcome.how, "folder": str(outcome.folder)}
    return {**facts, **manifest_json(outcome.manifest)}


def print_plans(plans: list[StagePlan], as_json: bool) -> None:
    """Print the state of each stage with its reasons, then the expected cost."""
    lines, facts = [], []
    for plan in plans:
        first, *others = plan.reasons or ("",)
        lines.append(f"{plan.stage:<12} {plan.state:<8} {first}".rstrip())
        lines += [f"{'':<21} {reason}" for reason in others]
        figures = ("minutes", "memory_gb", "disk_gb")
        estimate = plan.estimate and {name: getattr(plan.estimate, name) for name in figures}
        known = {"stage": plan.stage, "state": plan.state, "key": plan.key, "reasons": list(plan.reasons)}
        facts.append({**known, "estimate": estimate})
    answer(as_json, facts, *lines, *filter(None, [cost_line(plans)]))
