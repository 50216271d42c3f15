"""``cleargs report``: a run as a page to look at and to hand on."""

from __future__ import annotations

from pathlib import Path

import click

from cleargs.cli.common import (
    json_option,
    opened_store,
    print_json,
    quiet_option,
    run_argument,
    store_option,
    threads_or_all,
)
from cleargs.cli.progress import make_reporter
from cleargs.pipeline.dag import Dag
from cleargs.pipeline.plan import Planner
from cleargs.pipeline.run_file import read_run_file


@click.command(
    epilog="""\b
Examples:
  cleargs report room              room/report/index.html: open it in a browser, offline, or send the folder
"""
)
@run_argument
@click.option("--threads", type=click.IntRange(min=1), help="CPU threads.  [default: all cores]")
@store_option
@json_option
@quiet_option
@click.pass_obj
def report(
    dag: Dag, run: Path, threads: int | None, store: Path | None, as_json: bool, quiet: bool
) -> None:
    """Write RUN/report/index.html: the scene before and after in 3D, every frame and what became of it."""
    from cleargs.report.page import write_report

    settings = read_run_file(run, dag, store=store)
    with opened_store(settings.store) as opened:
        page = write_report(Planner(dag, settings, opened, threads_or_all(threads), make_reporter(quiet)))
    if as_json:
        print_json({"report": str(page)})
    else:
        click.echo(f"report: {page}")
