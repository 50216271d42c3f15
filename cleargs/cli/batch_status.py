"""``cleargs batch-status``: how far the scenes of a sheet are."""

from __future__ import annotations

from pathlib import Path

import click

from cleargs.batch.snakemake import engine_at_work
from cleargs.batch.status import scene_states
from cleargs.cli.batch import batch_folder, folder_option, print_states, sheet_argument
from cleargs.cli.common import json_option
from cleargs.errors import InputError


@click.command()
@sheet_argument
@folder_option
@json_option
def batch_status(sheet: Path, folder: Path | None, as_json: bool) -> int:
    """Say how far each scene of SHEET is, at any time, also while a batch is at work."""
    root = batch_folder(sheet, folder)
    plan = root.read_plan()
    if plan is None:
        raise InputError(f"there was no batch in {root.root}", hint=f"start one: cleargs batch {sheet}")
    print_states(scene_states(root, plan), plan, as_json)
    engine = engine_at_work(root)
    click.echo(f"at work: {engine}" if engine else "no batch is at work", err=True)
    return 0
