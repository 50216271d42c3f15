"""``cleargs settings``: every setting of the stages, from their models."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict

import click

from cleargs.cli.common import json_option, print_json
from cleargs.pipeline.dag import Dag
from cleargs.pipeline.settings import Setting, settings_of

INTRODUCTION = """\
# Settings

Every setting of the five stages, as `cleargs settings` lists them. Set one with
`cleargs run INPUT -o RUN --set g0.steps=4000`, or several in a TOML file for `--workflow FILE.toml`; those
of a run are in `RUN/run.toml`, and stay until `cleargs run` is told others. `seed` (0) belongs to no stage.

This page is made from the source: `cleargs settings --markdown > docs/settings.md`.
"""


@click.command(
    epilog="""\b
Examples:
  cleargs settings                  all of them
  cleargs settings g0               those of one stage
  cleargs run photos/ -o room --set g0.steps=4000 --set ingest.holdout=every:8
"""
)
@click.argument("stage", required=False)
@click.option("--markdown", is_flag=True, help="Print the page docs/settings.md.")
@json_option
@click.pass_obj
def settings(dag: Dag, stage: str | None, markdown: bool, as_json: bool) -> None:
    """List name, default, range and meaning of every setting, or of those of one STAGE."""
    names = dag.names if stage is None else (dag.check(stage),)
    found = {name: settings_of(name, dag.load(name).CONFIG) for name in names}
    if as_json:
        print_json([asdict(setting) for settings in found.values() for setting in settings])
    elif markdown:
        click.echo(_page(found), nl=False)
    else:
        _print(found)


def _page(found: Mapping[str, Sequence[Setting]]) -> str:
    lines = [INTRODUCTION]
    for stage, settings in found.items():
        lines += [f"## {stage}", "", "| setting | default | range | meaning |", "|---|---|---|---|"]
        for setting in settings:
            cells = (f"`{setting.name}`", f"`{setting.default_text}`", setting.allowed, setting.meaning)
            lines.append("| " + " | ".join(cell.replace("|", r"\|") for cell in cells) + " |")
        lines.append("")
    return "\n".join(lines)


def _print(found: Mapping[str, Sequence[Setting]]) -> None:
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    console = Console(highlight=False)
    for stage, settings in found.items():
        table = Table(box=None, header_style="bold", padding=(0, 1, 0, 0), pad_edge=False)
        table.add_column(f"{stage}.", no_wrap=True)
        table.add_column("default", max_width=14, overflow="fold")
        table.add_column("range", max_width=26)
        table.add_column("meaning")
        for setting in settings:
            name = setting.name.removeprefix(f"{stage}.")
            table.add_row(*map(Text, (name, setting.default_text, setting.allowed, setting.meaning)))
        console.print(table)
        console.print()
