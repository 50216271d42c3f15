"""``cleargs run``: a capture through all stages."""

from __future__ import annotations

from pathlib import Path

import click

from cleargs.cli.common import (
    json_option,
    output_option,
    partial_option,
    print_json,
    quality_option,
    quiet_option,
    report_option,
    store_option,
    threads_or_all,
    work_options,
)
from cleargs.cli.outcome import exit_code, outcome_json, print_outcomes, print_plans
from cleargs.cli.progress_bars import make_reporter
from cleargs.cli.report import older_report, report_on
from cleargs.pipeline.dag import Dag
from cleargs.pipeline.plan import Planner
from cleargs.pipeline.runner import Runner, check_same_input
from cleargs.pipeline.session import DeviceChoice, asked_run, opened_store


@click.command(
    epilog="""\b
Examples:
  cleargs run video.mp4 -o room
  cleargs run photos/ -o room --workflow smoke            does it work at all, in a minute
  cleargs run photos/ -o room --quality draft             a look; then the same with --quality standard
  cleargs run photos/ -o room --set ingest.max_frames=60 --set rva.tau_R=0.7
  cleargs run photos/ -o room --dry-run                   what would be done, why, and the cost
  cleargs run photos/ -o room --until rva                 stop before training
  cleargs run photos/ -o room --reset                     with the recipe's settings again
"""
)
@click.argument("source", metavar="INPUT", type=click.Path(path_type=Path))
@output_option("The run folder; the run resumes if it exists.", "folder", metavar="RUN")
@click.option(
    "--workflow",
    metavar="NAME|FILE.toml",
    help="The recipe: default, smoke, paper, paper-open, or a TOML file of your own.  [default: default; an "
    "existing run keeps its settings]",
)
@click.option(
    "--set",
    "overrides",
    multiple=True,
    metavar="STAGE.FIELD=VALUE",
    help="Change one setting (cleargs settings lists them).",
)
@quality_option
@click.option("--seed", type=click.IntRange(min=0), help="Seed of all randomness.  [default: 0]")
@click.option("--reset", is_flag=True, help="Forget the settings of an existing run: start from the recipe.")
@click.option("--until", metavar="STAGE", help="Stop after this stage.")
@click.option(
    "--force", multiple=True, metavar="STAGE", help="Make the stage again, even if its results are there."
)
@report_option("Write RUN/report/index.html at the end, as `cleargs report` does.")
@click.option("--dry-run", is_flag=True, help="Only say what would be done, why, and what it costs.")
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
    seed: int | None,
    reset: bool,
    until: str | None,
    force: tuple[str, ...],
    wants_report: bool,
    dry_run: bool,
    allow_partial: bool,
    device: DeviceChoice,
    threads: int | None,
    store: Path | None,
    as_json: bool,
    quiet: bool,
) -> int:
    """Turn INPUT into a clean scene in the folder RUN.

    INPUT is a video, an image folder, a COLMAP project (images/ and sparse/0), or a folder with
    transforms.json or poses_bounds.npy. Results that are there already are not made again; an interrupted
    run resumes. An existing run keeps its settings (RUN/run.toml) unless --set, --workflow or --reset say
    otherwise.
    """
    dag.until(until)
    reporter = make_reporter(quiet)
    settings = asked_run(
        dag,
        source,
        folder,
        workflow=workflow,
        overrides=(*quality, *overrides),
        seed=seed,
        reset=reset,
        store=store,
        device=device,
        say=reporter.info,
    )
    with opened_store(settings.store) as opened:
        check_same_input(settings, dag, opened)
        if dry_run:
            planner = Planner(dag, settings, opened, threads_or_all(threads), reporter)
            print_plans(planner.plan(until, tuple(dag.check(name) for name in force)), as_json)
            return 0
        runner = Runner(dag, settings, opened, threads_or_all(threads), reporter)
        outcomes = runner.run_until(until, force=force, allow_partial=allow_partial)
        page = report_on(runner.planner, outcomes) if wants_report else None
        if not wants_report and (line := older_report(settings.folder, dag)):
            reporter.info(line)
    if as_json:
        print_json([outcome_json(outcome) for outcome in outcomes])
    else:
        print_outcomes(outcomes, settings.folder, page)
    return exit_code(outcomes)
