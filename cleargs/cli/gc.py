"""``cleargs gc``: clear the store of what no run links to."""

from __future__ import annotations

from pathlib import Path

import click

from cleargs.cli.common import json_option, print_json, store_option
from cleargs.errors import InputError
from cleargs.pipeline.dag import Dag
from cleargs.pipeline.run_file import read_run_file
from cleargs.pipeline.session import opened_store
from cleargs.pipeline.store import ROOTS


@click.command(
    epilog="""\b
Examples:
  cleargs gc room --dry-run         what would go
  cleargs gc --store /data/store    a store that several runs share
"""
)
@click.argument("run", required=False, type=click.Path(file_okay=False, path_type=Path))
@store_option
@click.option(
    "--checkpoints",
    is_flag=True,
    help="Remove the checkpoints of interrupted work, and what is kept about single frames, too.",
)
@click.option("--dry-run", is_flag=True, help="Only say what would be removed.")
@json_option
@click.pass_obj
def gc(
    dag: Dag, run: Path | None, store: Path | None, checkpoints: bool, dry_run: bool, as_json: bool
) -> None:
    """Remove the results that no run links to, from the store of RUN or from --store.

    A run counts as long as its folder exists where it was last used. Going back to settings whose results
    were removed makes them again.
    """
    if run is None and store is None:
        raise InputError("neither a run nor a store is named", hint="give RUN or --store DIR")
    root = store if run is None else read_run_file(run, dag, store=store).store
    assert root is not None
    if not root.is_dir():
        raise InputError(f"there is no store {root}", hint="give the folder that was passed as --store")
    if run is None and not (root / ROOTS).is_dir():  # every run that uses a store is noted there
        raise InputError(
            f"{root} is no store", hint="give the folder that was passed as --store, or RUN without --store"
        )
    with opened_store(root) as opened:
        if run is not None and not dry_run:
            opened.add_root(run.absolute())
        garbage = opened.collect(dag.names, checkpoints=checkpoints, dry_run=dry_run)
    if as_json:
        print_json([{"folder": str(item.folder), "kind": item.kind, "bytes": item.bytes} for item in garbage])
        return
    for item in garbage:
        click.echo(f"{item.bytes / 1e6:>9.1f} MB  {item.kind:<10}  {item.folder.relative_to(opened.root)}")
    word = "would be freed" if dry_run else "freed"
    click.echo(f"{sum(item.bytes for item in garbage) / 1e6:>9.1f} MB  {word}")
