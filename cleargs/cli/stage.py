"""``cleargs stage``: one stage of a prepared run, as a cluster calls it."""

from __future__ import annotations

from pathlib import Path

import click

from cleargs.cli.common import (
    json_option,
    partial_option,
    print_json,
    quiet_option,
    run_argument,
    store_option,
    threads_or_all,
    work_options,
)
from cleargs.cli.outcome import exit_code, outcome_json, print_outcomes
from cleargs.cli.progress_bars import make_reporter
from cleargs.cli.report import report_on
from cleargs.pipeline.dag import Dag
from cleargs.pipeline.run_file import read_run_file
from cleargs.pipeline.runner import Runner
from cleargs.pipeline.session import DeviceChoice, opened_store, resolve_device


@click.command(
    epilog="""\b
Example:
  cleargs run photos/ -o room --until ingest
  cleargs stage rva room
"""
)
@click.argument("name")
@run_argument
@click.option("--force", is_flag=True, help="Make the stage again, even if its results are there.")
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
    threads: int | None,
    store: Path | None,
    as_json: bool,
    quiet: bool,
) -> int:
    """Run the one stage NAME of RUN with the settings in RUN/run.toml.

    The stages before it must be done.
    """
    dag.check(name)
    resolved = None if device == "auto" else resolve_device(device, click.echo)
    settings = read_run_file(run, dag, store=store, device=resolved)
    with opened_store(settings.store) as opened:
        runner = Runner(dag, settings, opened, threads_or_all(threads), make_reporter(quiet))
        outcome = runner.run_stage(name, force=force, allow_partial=allow_partial)
        if wants_report:
            report_on(runner.planner, [outcome])
    if as_json:
        print_json(outcome_json(outcome))
    else:
        print_outcomes([outcome], settings.folder)
    return exit_code([outcome])
