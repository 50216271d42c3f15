"""``cleargs batch``: all scenes of a sheet, here or on a cluster."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import click

from cleargs.batch.folder import BatchFolder, Plan
from cleargs.batch.preparation import Preparation
from cleargs.batch.scenes import Scene, read_scenes
from cleargs.batch.sheet import SheetError
from cleargs.batch.snakemake import engine_command, is_local, only_batch, profile_folder, run_engine
from cleargs.batch.status import SceneState, scene_states
from cleargs.cli.common import (
    json_option,
    output_option,
    print_json,
    quality_option,
    quiet_option,
    report_option,
)
from cleargs.cli.progress_bars import make_reporter
from cleargs.errors import CleargsError, InputError, StageError
from cleargs.pipeline.config import override
from cleargs.pipeline.dag import Dag
from cleargs.pipeline.run_file import Device
from cleargs.pipeline.session import DeviceChoice, resolve_device, usable_cores
from cleargs.progress import Reporter, Task
from cleargs.report.report_json import page_of

sheet_argument = click.argument("sheet", type=click.Path(dir_okay=False, path_type=Path))
folder_option = output_option(
    "The folder of the batch, on a disk that all nodes share.  [default: SHEET with the ending .batch]",
    "folder",
    metavar="BATCH",
    required=False,
)


@click.command(
    epilog="""\b
Examples:
  cleargs batch captures.toml --dry-run          check the sheet, count the jobs
  cleargs batch captures.toml                    on this machine
  cleargs batch captures.csv --profile slurm     on a Slurm cluster
  cleargs batch-status captures.csv              from any terminal, meanwhile
"""
)
@sheet_argument
@folder_option
@click.option(
    "--profile", default="local", show_default=True, metavar="local|slurm|FOLDER", help="Where to run."
)
@click.option("--until", metavar="STAGE", help="Stop after this stage.")
@quality_option
@click.option("--dry-run", is_flag=True, help="Only check the sheet and say how many jobs there are.")
@click.option("--allow-partial", is_flag=True, help="Continue after a stage that is done only in part.")
@click.option(
    "--device",
    type=click.Choice(["auto", "cpu", "cuda"]),
    default="auto",
    show_default=True,
    help="Where to compute. Today auto is the CPU.",
)
@report_option("Write a report of every scene, and BATCH/report/index.html, which leads to them.")
@click.option("--cores", type=click.IntRange(min=1), help="Cores for local jobs.  [default: all]")
@json_option
@quiet_option
@click.pass_obj
def batch(
    dag: Dag,
    sheet: Path,
    folder: Path | None,
    profile: str,
    until: str | None,
    quality: tuple[str, ...],
    dry_run: bool,
    allow_partial: bool,
    device: DeviceChoice,
    wants_report: bool,
    cores: int | None,
    as_json: bool,
    quiet: bool,
) -> int:
    """Bring every scene of SHEET (TOML or CSV) through the stages.

    A scene that fails does not stop the others. The same command again does only what is missing.
    """
    dag.until(until)
    place = profile_folder(profile)
    root = batch_folder(sheet, folder)
    command = _engine(root, place, cores or usable_cores(), dry_run=dry_run)
    reporter = make_reporter(quiet)
    elsewhere = device == "cuda" and not is_local(place)
    resolved: Device = "cuda" if elsewhere else resolve_device(device, reporter.info)
    options = ("--allow-partial",) if allow_partial else ()
    preparation = Preparation(dag, root, resolved, until, options, report=wants_report)
    scenes = checked_scenes(sheet, preparation, quality)
    return run_batch(preparation, scenes, command, reporter, dry_run=dry_run, as_json=as_json)


def _engine(root: BatchFolder, place: Path, cores: int, *, dry_run: bool) -> list[str]:
    """The call of Snakemake; empty where it is not installed and nothing is to be run."""
    try:
        return engine_command(root, place, cores=cores, dry_run=dry_run)
    except InputError as error:
        if not dry_run:
            raise
        click.echo(f"note: {error}; {error.hint}", err=True)
        return []


def run_batch(
    preparation: Preparation,
    scenes: Sequence[Scene],
    command: Sequence[str],
    reporter: Reporter,
    *,
    dry_run: bool = False,
    as_json: bool = False,
) -> int:
    """Make the scenes ready, run the engine, print what became of them; returns the exit code."""
    folder = preparation.folder
    with only_batch(folder) as lock:
        plan = preparation.prepare(scenes, reporter, dry_run=dry_run)
        if dry_run:
            if command and run_engine(command, folder, lock, lambda: None):
                raise StageError(
                    "Snakemake cannot plan the batch", hint=f"see the end of {folder.engine_log}"
                )
            _print_jobs(folder, plan, as_json)
            return 0
        with reporter.task("stages", len(plan.scenes) * len(plan.wanted)) as task:
            code = run_engine(command, folder, lock, _teller(folder, plan, reporter, task))
    states = scene_states(folder, plan, ended=True)
    print_states(states, plan, as_json)
    page = _page(folder, plan, states, reporter) if plan.report else None
    if not plan.report and (older := page_of(folder.root)).is_file():
        reporter.info(f"note: {older} shows an earlier batch; without --no-report it is made anew")
    if page is not None and not as_json:
        click.echo(f"report: {page}")
    kinds = {state.state for state in states}
    if "failed" in kinds or (code and "partial" not in kinds):
        click.echo(f"what Snakemake said: {folder.engine_log}", err=True)
        return 1
    return 3 if "partial" in kinds else 0


def _page(folder: BatchFolder, plan: Plan, states: Sequence[SceneState], reporter: Reporter) -> Path | None:
    """The report of the batch; None where it could not be written, which is no failure of the batch."""
    from cleargs.report.batch_page import write_batch

    try:
        return write_batch(folder, plan, states)
    except CleargsError as error:
        reporter.warn(f"there is no report: {error}; {error.hint}")
        return None


def checked_scenes(sheet: Path, preparation: Preparation, overrides: Sequence[str] = ()) -> list[Scene]:
    """The scenes of ``sheet``, with settings for all of them on top.

    The mistakes of the sheet go to stderr, one line each, before SheetError is raised.
    """
    try:
        dag = preparation.dag
        scenes = [
            replace(scene, config=override(dag, scene.config, overrides)) for scene in read_scenes(sheet, dag)
        ]
        conflicts = preparation.conflicts(scenes)
        if conflicts:
            raise SheetError(sheet, conflicts)
        return scenes
    except SheetError as error:
        for problem in error.problems:
            click.echo(f"{sheet}:{problem.line}: {problem.text}", err=True)
        raise


def batch_folder(sheet: Path, folder: Path | None) -> BatchFolder:
    """The folder of the batch of ``sheet``."""
    return BatchFolder((folder or sheet.with_suffix(".batch")).absolute())


def print_states(states: Sequence[SceneState], plan: Plan, as_json: bool) -> None:
    """A line a scene, then how many there are of each kind."""
    if as_json:
        print_json([_state_json(state) for state in states])
        return
    wide = max(len(state.scene) for state in states)
    for state in states:
        line = (
            f"{state.scene:<{wide}}  {state.state:<8} {state.finished}/{len(plan.wanted)}  {state.stage:<12}"
        )
        click.echo(" ".join([line, *filter(None, (state.where, state.cause))]).rstrip())
        if state.state in ("failed", "partial") and state.log is not None:
            click.echo(f"{'':<{wide}}  log: {state.log}")
    counts = Counter(state.state for state in states)
    click.echo(", ".join(f"{count} {kind}" for kind, count in counts.items()))


def _print_jobs(folder: BatchFolder, plan: Plan, as_json: bool) -> None:
    """How many jobs there would be."""
    jobs = {
        stage: sum(folder.read_handle(scene, stage) is None for scene in plan.scenes) for stage in plan.wanted
    }
    if as_json:
        print_json({"scenes": len(plan.scenes), "jobs": jobs})
        return
    each = ", ".join(f"{stage} {count}" for stage, count in jobs.items())
    click.echo(f"{len(plan.scenes)} scenes, {sum(jobs.values())} stages to do: {each}")


def _state_json(state: SceneState) -> dict[str, object]:
    return {
        "scene": state.scene,
        "state": state.state,
        "stage": state.stage,
        "finished": state.finished,
        "where": state.where,
        "cause": state.cause,
        "log": None if state.log is None else str(state.log),
    }


def _teller(folder: BatchFolder, plan: Plan, reporter: Reporter, task: Task) -> Callable[[], None]:
    """What tells the user of every change, scene by scene."""
    known = {state.scene: state for state in scene_states(folder, plan)}

    def look() -> None:
        states = scene_states(folder, plan)
        for state in states:
            before = known[state.scene]
            if (before.state, before.stage) != (state.state, state.stage) and state.state != "waiting":
                reporter.info(
                    " ".join(filter(None, (f"{state.scene} {state.stage}: {state.state}", state.where)))
                )
            known[state.scene] = state
        counts = Counter(state.state for state in states)
        note = ", ".join(
            f"{counts[kind]} {kind}" for kind in ("running", "failed", "partial") if counts[kind]
        )
        task.update(done=sum(state.finished for state in states), note=note)

    return look
