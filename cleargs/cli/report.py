"""``cleargs report`` and ``watch``: a run as a page, finished or at work."""

from __future__ import annotations

import resource
from collections.abc import Sequence
from contextlib import suppress
from ipaddress import ip_address
from pathlib import Path
from shlex import quote

import click

from cleargs.cli.common import (
    answer,
    json_option,
    quiet_option,
    run_argument,
    store_option,
    threads_option,
)
from cleargs.cli.progress_bars import make_reporter
from cleargs.errors import CleargsError
from cleargs.pipeline.dag import Dag
from cleargs.pipeline.plan import Planner
from cleargs.pipeline.run_file import read_run_file
from cleargs.pipeline.runner import StageOutcome
from cleargs.pipeline.session import opened_store


@click.command(
    epilog="""\b
Examples:
  cleargs report room              room/report/index.html: open it in a browser, offline, or send the folder
"""
)
@run_argument
@threads_option
@store_option
@json_option
@quiet_option
@click.pass_obj
def report(dag: Dag, run: Path, threads: int, store: Path | None, as_json: bool, quiet: bool) -> None:
    """Write RUN/report/index.html: the scene before and after in 3D, every frame and what became of it."""
    from cleargs.report.page import write_report

    settings = read_run_file(run, dag, store=store)
    reporter = make_reporter(quiet)
    with opened_store(settings.store) as opened:
        page = write_report(Planner(dag, settings, opened, threads, reporter))
    answer(as_json, {"report": str(page)}, f"report: {page}")


def report_on(planner: Planner, outcomes: Sequence[StageOutcome]) -> Path | None:
    """The report at the end of a run; None where there is nothing to report on, or it could not be written.

    A report that shows these results already stays.
    """
    from cleargs.report.report_json import LastRun, is_current, linked_manifests, page_of

    run = planner.run.folder
    manifests = linked_manifests(run, planner.dag.names)
    if "ingest" not in manifests:
        return None
    if all(outcome.how == "found" for outcome in outcomes) and is_current(run, manifests):
        return page_of(run)
    from cleargs.report.page import write_report

    usage = (resource.getrusage(who).ru_maxrss for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    last = LastRun({outcome.stage: outcome.how for outcome in outcomes}, round(max(usage) * 1024 / 1e9, 2))
    try:
        return write_report(planner, last)
    except CleargsError as error:  # the run itself has succeeded
        planner.reporter.warn(f"there is no report: {error}; {error.hint}")
        return None


def older_report(run: Path, dag: Dag) -> str:
    """The line that tells of a report of ``run`` that does not show its present results; "" for none."""
    from cleargs.report.report_json import is_current, linked_manifests, page_of

    page = page_of(run)
    if not page.is_file() or is_current(run, linked_manifests(run, dag.names)):
        return ""
    return f"note: {page} shows earlier results; `cleargs report {quote(str(run))}` makes it anew"


@click.command(
    epilog="""\b
Examples:
  cleargs watch room                     the address to open stands on the first line
  cleargs watch room --port 8000
  ssh -L 8000:localhost:8000 HOST cleargs watch room --port 8000      a run on another machine

\b
While a run is at work the page shows the stage, its figures, the time left, and the scene at the last
checkpoint; it renews itself. Afterwards it shows the report.
"""
)
@run_argument
@click.option(
    "--host",
    default="127.0.0.1",
    show_default=True,
    help="Address to listen at. Any other than this one lets other machines read the report.",
)
@click.option(
    "--port",
    type=click.IntRange(0, 65_535),
    default=0,
    help="Port to listen at.  [default: one that is free]",
)
@store_option
@click.pass_obj
def watch(dag: Dag, run: Path, host: str, port: int, store: Path | None) -> None:
    """Serve the report of RUN, and how far it is while it is at work, until Ctrl-C."""
    from cleargs.report.serve import Server

    with Server(dag, read_run_file(run, dag, store=store), host, port) as server:
        loopback = host == "localhost"
        with suppress(ValueError):
            loopback = ip_address(host).is_loopback
        if not loopback:
            click.echo(f"warning: whoever reaches {host} can read the report of this run", err=True)
        click.echo(f"{server.address}  (Ctrl-C ends it)")
        with suppress(KeyboardInterrupt):
            server.serve_forever()
