"""``cleargs watch``: a run in the browser while it is at work, then its report."""

from __future__ import annotations

from contextlib import suppress
from ipaddress import ip_address
from pathlib import Path

import click

from cleargs.cli.common import run_argument, store_option
from cleargs.pipeline.dag import Dag
from cleargs.pipeline.run_file import read_run_file

HERE = "127.0.0.1"


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
    default=HERE,
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
        if not _is_loopback(host):
            click.echo(f"warning: whoever reaches {host} can read the report of this run", err=True)
        click.echo(f"{server.address}  (Ctrl-C ends it)")
        with suppress(KeyboardInterrupt):
            server.serve_forever()


def _is_loopback(host: str) -> bool:
    try:
        return ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"
