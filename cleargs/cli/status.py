"""``cleargs status``: the state of each stage of a run, and the reasons."""

from __future__ import annotations

from pathlib import Path

import click

from cleargs.cli.common import json_option, run_argument, store_option, threads_or_all
from cleargs.cli.outcome import print_plans
from cleargs.cli.progress_bars import make_reporter
from cleargs.pipeline.dag import Dag
from cleargs.pipeline.plan import Planner
from cleargs.pipeline.run_file import read_run_file
from cleargs.pipeline.session import opened_store


@click.command(
    epilog="""\b
States:
  done     the results are there and whole
  partial  the results are there, something is missing; the next run tries again
  missing  to be made: the line says which setting, input file or version changed
"""
)
@run_argument
@store_option
@json_option
@click.pass_obj
def status(dag: Dag, run: Path, store: Path | None, as_json: bool) -> None:
    """Say for each stage of RUN whether it is done, partial or missing, and what changed."""
    settings = read_run_file(run, dag, store=store)
    with opened_store(settings.store) as opened:
        planner = Planner(dag, settings, opened, threads_or_all(None), make_reporter())
        print_plans(planner.plan(), as_json)
