"""``cleargs diff``: the settings and figures of two runs."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import click

from cleargs.cli.common import FOLDER, json_option, print_json
from cleargs.cli.show import LABELS
from cleargs.errors import InputError
from cleargs.pipeline.run_file import RunSpec, read_run_file
from cleargs.pipeline.stages import Stages
from cleargs.report.report_json import linked_manifests

FIGURES = ("frames", "registered", "gaussians", "psnr_unseen", "repairs")
"""Figures in the manifest of a stage that are compared."""


@click.command(
    epilog="""\b
Example:
  cleargs diff room room-high      no true images are needed; figures of `cleargs eval` are listed if present
"""
)
@click.argument("first", metavar="RUN", type=FOLDER)
@click.argument("second", metavar="RUN", type=FOLDER)
@json_option
@click.pass_obj
def diff(dag: Stages, first: Path, second: Path, as_json: bool) -> None:
    """List the settings in which two runs differ, and their figures side by side."""
    runs = [read_run_file(run, dag) for run in (first, second)]
    settings = _paired(*(dict(_settings(run)) for run in runs))
    figures = _paired(*(dict(_figures(run, dag)) for run in runs))
    changed = {name: pair for name, pair in settings if pair[0] != pair[1]}
    found = {"settings": changed, "figures": dict(figures)}
    if as_json:
        print_json({"runs": [str(first), str(second)], **found})
        return
    from rich.console import Console
    from rich.table import Table

    table = Table(box=None, header_style="bold", padding=(0, 2, 0, 0), pad_edge=False)
    for column in ("", str(first), str(second), "difference"):
        table.add_column(column, justify="right" if column else "left", overflow="fold")
    for title, rows in found.items():
        table.add_row(title if rows else f"{title}: equal", style="bold")
        for name, (one, other) in rows.items():
            both = all(isinstance(value, int | float) for value in (one, other)) and title == "figures"
            table.add_row(name, _text(one), _text(other), f"{other - one:+.4g}" if both else "")
    Console(highlight=False, markup=False).print(table)


def _text(value: Any) -> str:
    return "-" if value is None else f"{value:.4g}" if isinstance(value, float) else str(value)


def _paired(one: dict[str, Any], other: dict[str, Any]) -> Iterator[tuple[str, list[Any]]]:
    for name in dict.fromkeys((*one, *other)):
        yield name, [one.get(name), other.get(name)]


def _settings(run: RunSpec) -> Iterator[tuple[str, Any]]:
    """Yield name and value of the input, the device, the seed and all settings of a run."""
    yield from (("input", str(run.source)), ("device", run.device), ("seed", run.config.seed))
    yield from ((setting.name, value) for setting, value in run.config.settings())


def _figures(run: RunSpec, dag: Stages) -> Iterator[tuple[str, Any]]:
    """Yield label and value of the figures of a run, from its stages and its evaluations."""
    from cleargs.evaluate.eval_report import read_report

    made = linked_manifests(run.folder, dag.names)
    for name, manifest in made.items():
        known = [key for key in FIGURES if manifest.summary.get(key) is not None and name != "rva"]
        yield from ((f"{name}: {LABELS.get(key, key)}", manifest.summary[key]) for key in known)
        yield f"{name}: time, s", round(manifest.seconds, 1)
    yield "all stages: time, s", round(sum(manifest.seconds for manifest in made.values()), 1)
    for file in sorted(run.folder.glob("eval/*/eval.json")):
        try:
            report = read_report(file)
        except InputError:
            continue  # damaged, or of another version
        for found in report.evaluations:
            for metric, mean in found.means.items():
                yield f"eval {file.parent.name}, {found.subject}: {metric}", mean
