"""``cleargs settings``: list the settings of the stages."""

from __future__ import annotations

import shutil
import textwrap
from dataclasses import asdict

import click

from cleargs.cli.common import complete_stage, json_option, print_json
from cleargs.pipeline.settings import settings_of
from cleargs.pipeline.stages import Stages


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
def settings(dag: Stages, stage: str | None, as_json: bool) -> None:
    """List all settings, or those of one STAGE: name = default, range, meaning."""
    names = dag.names if stage is None else (dag.check(stage),)
    found = {name: settings_of(name, dag.load(name).CONFIG) for name in names}
    if as_json:
        print_json([asdict(setting) for settings in found.values() for setting in settings])
        return
    width = max(40, shutil.get_terminal_size().columns)
    for setting in (setting for settings in found.values() for setting in settings):
        allowed = f"  ({setting.allowed})" if setting.allowed else ""
        for text, indent in (
            (f"{setting.name} = {setting.default_text}{allowed}", ""),
            (setting.meaning, "    "),
        ):
            lines = textwrap.wrap(text, width, initial_indent=indent, subsequent_indent="    ")
            click.echo("\n".join(lines))
        click.echo()
