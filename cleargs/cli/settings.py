"""``cleargs settings``: list the settings of the stages."""

from __future__ import annotations

from dataclasses import asdict

import click

from cleargs.cli.common import complete_stage, json_option, print_json
from cleargs.pipeline.dag import Dag
from cleargs.pipeline.settings import settings_of


@click.command(
    epilog="""\b
Examples:
  cleargs settings                  all settings
  cleargs settings g0               the settings of one stage
  cleargs run photos/ -o room --set g0.steps=4000 --set ingest.holdout=every:8
"""
)
@click.argument("stage", required=False, shell_complete=complete_stage)
@json_option
@click.pass_obj
def settings(dag: Dag, stage: str | None, as_json: bool) -> None:
    """List all settings, or those of one STAGE, with default, range and meaning."""
    names = dag.names if stage is None else (dag.check(stage),)
    found = {name: settings_of(name, dag.load(name).CONFIG) for name in names}
    if as_json:
        print_json([asdict(setting) for settings in found.values() for setting in settings])
        return
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    console = Console(highlight=False)
    for name, settings in found.items():
        table = Table(box=None, header_style="bold", padding=(0, 1, 0, 0), pad_edge=False)
        table.add_column(f"{name}.", no_wrap=True)
        table.add_column("default", max_width=14, overflow="fold")
        table.add_column("range", max_width=26)
        table.add_column("meaning")
        for setting in settings:
            field = setting.name.removeprefix(f"{name}.")
            table.add_row(*map(Text, (field, setting.default_text, setting.allowed, setting.meaning)))
        console.print(table)
        console.print()
