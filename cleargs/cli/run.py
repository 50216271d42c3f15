"""``cleargs run``, ``stage`` and ``status``: run the stages of a run, or show their state."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from shlex import quote
from typing import Any

import click
from click.core import ParameterSource

import cleargs
from cleargs.capture.config import CaptureConfig
from cleargs.capture.sources import open_capture, whole_capture
from cleargs.cli.commands import as_called
from cleargs.cli.common import (
    DONE_IN_PART,
    answer,
    complete_stage,
    json_option,
    kept_log,
    manifest_json,
    open_option,
    output_option,
    partial_option,
    print_json,
    quality_option,
    quiet_option,
    recipe_option,
    report_option,
    run_argument,
    set_option,
    store_option,
    until_option,
    verbose_option,
    with_shortcuts,
    work_options,
)
from cleargs.cli.outcome_lines import outcome_lines, print_lines
from cleargs.cli.progress_bars import LOG, make_reporter
from cleargs.cli.report import outdated_report_note, write_run_report
from cleargs.errors import StageError
from cleargs.packed import WORKS, read_pack
from cleargs.pipeline.config import Config
from cleargs.pipeline.live import stage_at_work
from cleargs.pipeline.plan import Planner, StagePlan, cost_line, cost_text
from cleargs.pipeline.run_file import RUN_FILE, RUN_LOG, read_run_file
from cleargs.pipeline.runner import Runner, check_same_input
from cleargs.pipeline.session import DeviceChoice, default_folder, opened_store, resolve_run, usable_cores
from cleargs.pipeline.settings import flattened
from cleargs.pipeline.stages import Stages
from cleargs.progress import SilentReporter
from cleargs.report.report_json import ENTRY, linked_manifests


@click.command(
    epilog="""\b
Examples:
  cleargs run walk.mp4                            into the folder walk
  cleargs run walk.mp4 --start 3 --end 40         a part of it, in seconds
  cleargs run photos/ -o room --quality draft     a first look with fewer and smaller frames
  cleargs run photos/ --recipe smoke              a quick test, into the folder photos-scene
  cleargs run photos/ -o room --max-frames 60 --set rva.tau_R=0.7
  cleargs run photos/ -o room --dry-run           the stages that would run, why, and the cost
  cleargs run photos/ -o room --until rva         stop before training
  cleargs run photos/ -o room --reset             go back to the settings of the recipe

\b
Files in RUN:
  scene.ply     the scene
  report.html   the report
  run.log       the messages of all calls, with their times
"""
)
@click.argument("source", metavar="INPUT", type=click.Path(path_type=Path))
@output_option(
    "The run folder. An existing run is resumed.  [default: next to INPUT; walk for walk.mp4, walk-scene "
    "for a folder walk]",
    "folder",
    metavar="RUN",
    required=False,
)
@quality_option
@recipe_option
@set_option
@click.option("--steps", type=click.IntRange(min=1), metavar="N", help="Training steps of the first scene.")
@click.option("--max-frames", type=click.IntRange(min=3), metavar="N", help="Most frames of a video to use.")
@click.option("--size", type=click.IntRange(min=64), metavar="PX", help="Long side of the images.")
@click.option(
    "--holdout", metavar="every:N|LIST", help="Frames for `cleargs eval RUN`, which no training uses."
)
@click.option("--start", type=click.FloatRange(min=0), metavar="S", help="Take a video from this second on.")
@click.option(
    "--end", type=click.FloatRange(min=0, min_open=True), metavar="S", help="Take a video up to this second."
)
@click.option("--only", metavar="GLOB", help="Take only these files of a folder, such as 'cam0' or '*.jpg'.")
@click.option("--skip", metavar="GLOB", help="Leave out these files of a folder.")
@click.option("--seed", type=click.IntRange(min=0), help="Seed of all random numbers.  [default: 0]")
@click.option("--reset", is_flag=True, help="Replace the settings of an existing run by those of the recipe.")
@until_option
@click.option(
    "--force",
    multiple=True,
    metavar="STAGE",
    shell_complete=complete_stage,
    help="Run this stage even if its results exist.",
)
@report_option("Write RUN/report.html at the end, which opens the report.")
@open_option("Open the report in the browser at the end.")
@click.option("--dry-run", is_flag=True, help="Only show which stages would run, why, and the cost.")
@partial_option
@work_options
@store_option
@json_option
@quiet_option
@verbose_option
@click.pass_context
def run(
    context: click.Context,
    /,
    source: Path,
    folder: Path | None,
    recipe: str | None,
    overrides: tuple[str, ...],
    seed: int | None,
    reset: bool,
    until: str | None,
    force: tuple[str, ...],
    wants_report: bool,
    opens: bool,
    dry_run: bool,
    allow_partial: bool,
    device: DeviceChoice,
    threads: int,
    store: Path | None,
    as_json: bool,
    quiet: bool,
    **shortcuts: Any,
) -> int:
    """Turn INPUT into a clean scene in the folder RUN.

    INPUT is a video, a folder of videos or of images, a COLMAP project (images/ and sparse/0), or a folder
    with transforms.json or poses_bounds.npy. An existing RUN can be given in its place. Existing results are
    reused, and an interrupted run resumes. An existing run keeps its settings (RUN/run.toml) until an option,
    --recipe or --reset changes them.
    """
    dag: Stages = context.obj
    dag.until(until)
    if folder is None and (source / RUN_FILE).is_file():  # the user gives the run in place of its capture
        folder, source = source, read_run_file(source, dag).source
    source, given_as = whole_capture(source), source
    folder = folder or default_folder(source)
    if (folder / RUN_FILE).is_file():  # the user's configuration file is for new runs
        of_user = ParameterSource.DEFAULT_MAP
        kept = [x for x in ("store", "device", "quality") if context.get_parameter_source(x) is of_user]
        store = None if "store" in kept else store
        device = "auto" if "device" in kept else device
        shortcuts["quality"] = None if "quality" in kept else shortcuts["quality"]
    given = with_shortcuts(overrides, shortcuts)
    with kept_log(context, folder / RUN_LOG, writes=not dry_run) as log:
        reporter = make_reporter(quiet)
        if source != given_as:
            reporter.info(f"{given_as} is part of the capture {source}, which is read")
        settings = resolve_run(
            dag,
            source,
            folder,
            recipe=recipe,
            overrides=given,
            seed=seed,
            reset=reset,
            store=store,
            device=device,
            test_gpu=not dry_run,
            reporter=reporter,
        )
        for line in without_effect(settings.config, given):
            reporter.warn(line)
        with opened_store(settings.store) as opened:
            check_same_input(settings, dag, opened)
            runner = Runner(dag, settings, opened, threads, reporter)
            if dry_run:
                plans = runner.plan(until, tuple(dag.check(name) for name in force))
                reading = settings.config.effective.get("ingest")
                if isinstance(reading, CaptureConfig) and plans[0].estimate is not None:
                    for note in open_capture(source, reading).remarks:
                        reporter.warn(note)
                print_plans(_with_outdated(plans, settings.folder, dag), as_json, settings.stages(dag))
                return 0
            log(
                f"cleargs {cleargs.__version__}, {settings.device}, {threads} threads, store {settings.store}"
            )
            outcomes = runner.run_until(until, force=force, allow_partial=allow_partial)
            page = write_run_report(runner, outcomes) if wants_report else None
            if not wants_report and (line := outdated_report_note(settings.folder, dag)):
                reporter.info(line)
        for outcome in outcomes:
            made = outcome.manifest
            cost = f"{made.seconds:.1f} s, {made.peak_memory_gb or 0:.2f} GB memory"
            log(f"{outcome.stage}: {outcome.how}, {cost}, key {made.key}")
        worked = [outcome for outcome in outcomes if outcome.stage in settings.stages(dag)]
        lines = outcome_lines(worked, folder, page and settings.folder / ENTRY)
        for line in lines:
            context.meta[LOG](line)
    if as_json:
        facts = ({"stage": one.stage, "how": one.how, "folder": str(one.folder)} for one in outcomes)
        print_json([fact | manifest_json(one.manifest) for fact, one in zip(facts, outcomes, strict=True)])
    else:
        print_lines(outcomes, lines)
    if opens and page is not None:
        click.launch(page.as_uri())
    return DONE_IN_PART if any(outcome.manifest.status == "partial" for outcome in outcomes) else 0


def without_effect(config: Config, given: Sequence[str]) -> Iterator[str]:
    """Yield a line for each of the ``given`` settings that this run does not use, or uses only in part."""
    wanted, used = (
        dict(flattened({name: model.model_dump(mode="json") for name, model in models.items()}))
        for models in (config.sections, config.effective)
    )
    names = [text.partition("=")[0].strip() for text in given]
    for name in names:
        if name in used and used[name] != wanted[name]:
            quality = used.get("g0.quality")
            yield f"{name}={wanted[name]} has no effect: with quality {quality} it is {used[name]}"
    fixed = [
        f"{name}={value}"
        for name, value in wanted.items()
        if name not in names and name.rpartition(".")[2] in ("steps", "budget") and value
    ]
    if "g0.quality" in names and fixed:
        yield (
            f"the quality does not change {', '.join(fixed)}; --recipe default --reset removes these settings"
        )


_RUN = run  # the command, whose name is an argument below


@click.command()
@click.argument("name", shell_complete=complete_stage)
@run_argument
@click.option("--force", is_flag=True, help="Run the stage even if its results exist.")
@report_option("Write the report at the end.")
@partial_option
@work_options
@store_option
@json_option
@quiet_option
@click.pass_context
def stage(context: click.Context, /, name: str, run: Path, force: bool, **options: Any) -> int:
    """Run the stage NAME of an existing RUN. All stages before it must be done."""
    settings = read_run_file(run, context.obj, store=options["store"])
    with opened_store(settings.store) as opened:
        planner = Planner(context.obj, settings, opened, options["threads"], SilentReporter())
        *before, _ = planner.plan(context.obj.check(name))
    enough = ("done", "partial") if options["allow_partial"] else ("done",)
    if needed := next((plan for plan in before if plan.state not in enough), None):
        state = "done only in part" if needed.state == "partial" else "not done"
        remedy = f"run first: cleargs stage {needed.stage} {quote(str(run))}"
        raise StageError(f"{name} needs {needed.stage}, which is {state}", hint=remedy)
    options |= {"source": run, "until": name, "force": (name,) if force else ()}
    return int(context.invoke(_RUN, **options))


@click.command(
    epilog="""\b
States:
  done      all results exist
  partial   some results are missing; the next run retries them
  outdated  results exist, of other settings, inputs or libraries; the line shows what changed. They can be
            used; the next run makes new ones
  missing   no results
  running   a process works on it now
  packed    results in a run of `cleargs pack`, which cannot be continued
"""
)
@run_argument
@store_option
@json_option
@click.pass_obj
def status(dag: Stages, run: Path, store: Path | None, as_json: bool) -> None:
    """Show for each stage of RUN if it is done, outdated or missing, and what changed."""
    settings = read_run_file(run, dag, store=store)
    if packed := read_pack(settings.folder):
        kept = Counter(file.partition("/")[0] for file in packed.files)
        found = linked_manifests(settings.folder, settings.stages(dag)).items()
        why = {name: f"{kept[name]} of {len(manifest.files) + 1} files" for name, manifest in found}
        print_plans([StagePlan(name, "packed", (text,)) for name, text in why.items()], as_json)
        click.echo(f"packed run: {WORKS}", err=as_json)
        return
    if not settings.source.exists():
        shown = linked_manifests(settings.folder, dag.names)
        plans = [StagePlan(name, "done" if name in shown else "missing", ()) for name in dag.names]
        print_plans(plans, as_json)
        note = (
            f"its input {settings.source} is gone; if it was moved: cleargs run NEWPLACE -o {quote(str(run))}"
        )
        click.echo(as_called(note), err=True)
        return
    with opened_store(settings.store) as opened:
        plans = Planner(dag, settings, opened, usable_cores(), make_reporter()).plan()
    plans = _with_outdated(plans, settings.folder, dag)
    if at_work := stage_at_work(settings.folder, settings.store):
        name, text = at_work
        working = text.startswith("running: ")
        plans = [
            replace(
                plan, state="running" if working else plan.state, reasons=(text.removeprefix("running: "),)
            )
            if plan.stage == name
            else plan
            for plan in plans
        ]
    print_plans(plans, as_json, settings.stages(dag))


def _with_outdated(plans: list[StagePlan], run: Path, dag: Stages) -> list[StagePlan]:
    """Return the plans; stages that have results of other settings or inputs are outdated, not missing."""
    shown = linked_manifests(run, dag.names)
    return [
        replace(plan, state="outdated") if plan.state == "missing" and plan.stage in shown else plan
        for plan in plans
    ]


def print_plans(plans: list[StagePlan], as_json: bool, stages: Sequence[str] = ()) -> None:
    """Print the state and cost of each stage, with its reasons, then the cost of all.

    ``stages`` are those that have work (none given: all). JSON also has the others.
    """
    lines, facts = [], []
    for plan in plans:
        first, *others = plan.reasons or ("",)
        cost = cost_text(plan.estimate) if plan.estimate is not None else ""
        if not stages or plan.stage in stages:
            lines.append(f"{plan.stage:<12} {plan.state:<8} {cost:<37} {first}".rstrip())
            lines += [f"{'':<59} {reason}" for reason in others]
        figures = ("minutes", "memory_gb", "disk_gb")
        estimate = plan.estimate and {name: getattr(plan.estimate, name) for name in figures}
        known = {"stage": plan.stage, "state": plan.state, "key": plan.key, "reasons": list(plan.reasons)}
        facts.append({**known, "estimate": estimate})
    answer(as_json, facts, *lines, *filter(None, [cost_line(plans)]))
