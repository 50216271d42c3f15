"""``cleargs report`` and ``watch``: show a finished or active run as a page."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from ipaddress import ip_address
from pathlib import Path
from shlex import quote
from typing import Any

import click

from cleargs.cli.common import (
    FILE,
    answer,
    edited_option,
    json_option,
    open_option,
    quiet_option,
    run_argument,
    store_option,
    threads_option,
)
from cleargs.cli.progress_bars import make_reporter
from cleargs.errors import CleargsError, InputError
from cleargs.named_views import keep_views
from cleargs.packed import read_pack, require_images
from cleargs.pipeline.outputs import check_outputs
from cleargs.pipeline.plan import Planner
from cleargs.pipeline.run_file import read_run_file
from cleargs.pipeline.runner import StageOutcome
from cleargs.pipeline.session import opened_store
from cleargs.pipeline.stages import Stages
from cleargs.report.report_json import ENTRY, is_current, is_own_page, linked_manifests, page_of


@click.command(
    epilog="""\b
Examples:
  cleargs report room                           room/report.html, which opens in any browser, also offline
  cleargs report room --single-file             one file to send: room/room-report.html
  cleargs report room --single-file -o a.html   the same under another name
  cleargs report room --scene edited.ply        with an edited copy of the scene
"""
)
@run_argument
@click.option(
    "--single-file", is_flag=True, help="Also write the report as one HTML file, with everything inside."
)
@click.option("-o", "--output", type=FILE, help="File of --single-file.  [default: RUN/NAME-report.html]")
@click.option(
    "--view",
    "views",
    multiple=True,
    metavar="NAME=X,Y,Z,X,Y,Z",
    help="Keep a view of the scene (position, target) in RUN, for the report and `export --for web`. "
    "The page prints this option. `start` is the first view; NAME= removes one.",
)
@edited_option
@open_option("Open the report in the browser.")
@threads_option
@store_option
@json_option
@quiet_option
@click.pass_obj
def report(
    dag: Stages,
    run: Path,
    single_file: bool,
    output: Path | None,
    views: tuple[str, ...],
    scene: Path | None,
    opens: bool,
    threads: int,
    store: Path | None,
    as_json: bool,
    quiet: bool,
) -> None:
    """Write RUN/report.html and RUN/report/: the scene in 3D, every frame, and how to improve the result."""
    if output is not None and not single_file:
        hint = f"cleargs report {quote(str(run))} --single-file -o FILE.html"
        raise InputError("-o needs --single-file", hint=hint)
    target = output or run / f"{run.resolve().name}-report.html"
    if single_file:
        if target.suffix.lower() not in (".html", ".htm"):
            raise InputError(f"{target} does not end in .html", hint="name the file NAME.html")
        check_outputs([target], dag, run)
        if target.exists() and not target.is_symlink() and not is_own_page(target):  # a link is replaced
            raise InputError(f"{target} exists and is not a report of ClearGS", hint="choose another name")
    from cleargs.report.page import write_report
    from cleargs.report.single_file import write_single_file

    settings = read_run_file(run, dag, store=store)
    if views:
        require_images(run, "a report with other views")
        keep_views(settings.folder, views)
    page = page_of(settings.folder)
    if read_pack(run) and page.is_file() and scene is None:
        click.echo("note: this is the report as it was packed; without images no other is possible", err=True)
    else:
        require_images(run, "a report")
        with opened_store(settings.store) as opened:
            write_report(Planner(dag, settings, opened, threads, make_reporter(quiet)), scene)
    address = (settings.folder / ENTRY).as_uri()
    facts: dict[str, Any] = {"report": str(page)}
    lines = [f"report: {address}"]
    if single_file:
        size = write_single_file(page, target)
        facts |= {"single_file": str(target), "bytes": size}
        lines = [f"written: {target} ({size / 1e6:.1f} MB)"]
    answer(as_json, facts, *lines)
    if opens:
        click.launch(address)


def write_run_report(planner: Planner, outcomes: Sequence[StageOutcome]) -> Path | None:
    """Write the report at the end of a run, unless a report of the same results exists.

    Return the page. Return None if ingest has no results, or if writing failed, which prints a warning.
    """
    run = planner.run.folder
    manifests = linked_manifests(run, planner.dag.names)
    if "ingest" not in manifests:
        return None
    if all(outcome.how == "found" for outcome in outcomes) and is_current(run, manifests):
        return page_of(run)
    from cleargs.report.page import write_report

    try:
        return write_report(planner)
    except CleargsError as error:  # the run itself has succeeded
        planner.reporter.warn(f"no report was written: {error}; {error.hint}")
        return None


def outdated_report_note(run: Path, dag: Stages) -> str:
    """Return a note if the report of ``run`` shows earlier results, or "" otherwise."""
    page = page_of(run)
    if not page.is_file() or is_current(run, linked_manifests(run, dag.names)):
        return ""
    return f"note: {page} shows earlier results; update it with `cleargs report {quote(str(run))}`"


@click.command(
    epilog="""\b
Examples:
  cleargs watch room --open              in your browser
  cleargs watch room --port 8000
  ssh -L 8000:localhost:8000 HOST cleargs watch room --port 8000      a run on another machine

\b
During a run, the page shows the stage, its figures, the time left, and the scene at the last checkpoint.
It updates itself. After the run, it shows the report.
"""
)
@run_argument
@click.option(
    "--host",
    default="127.0.0.1",
    show_default=True,
    help="Address to listen on. Most others allow other machines to read the report.",
)
@click.option(
    "--port", type=click.IntRange(0, 65_535), default=0, help="Port to listen on.  [default: any free port]"
)
@open_option("Open the page in the browser.")
@store_option
@click.pass_obj
def watch(dag: Stages, run: Path, host: str, port: int, opens: bool, store: Path | None) -> None:
    """Serve a page with the progress of RUN, and later its report, until Ctrl-C."""
    from cleargs.report.serve import Server

    with Server(dag, read_run_file(run, dag, store=store), host, port) as server:
        loopback = host == "localhost"
        with suppress(ValueError):
            loopback = ip_address(host).is_loopback
        if not loopback:
            click.echo(f"warning: anyone who can connect to {host} can read the report of this run", err=True)
        click.echo(f"{server.address}  (stop with Ctrl-C)")
        if opens:
            click.launch(server.address)
        with suppress(KeyboardInterrupt):
            server.serve_forever()
