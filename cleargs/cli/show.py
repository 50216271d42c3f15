"""``cleargs show``: the tables and figures of a run in the terminal."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from cleargs.cli.common import json_option, print_json, run_argument
from cleargs.cli.summary import describe_table, sampled_rows
from cleargs.errors import InputError
from cleargs.pipeline.dag import Dag
from cleargs.pipeline.digest import tree_digest
from cleargs.pipeline.manifest import Manifest, linked_manifest
from cleargs.pipeline.run_file import RUN_FILE

if TYPE_CHECKING:
    from rich.console import Console

PLOT = "rva-plot.png"
"""The picture of ``--plot`` in the run's folder, unless another is named."""


@click.command(
    epilog="""\b
Examples:
  cleargs show room                 all stages: state, time, size, figures
  cleargs show room rva             roles, weights and scores, column by column
  cleargs show room g0 --rows 12    rows of each table, evenly spread
  cleargs show room rva --plot      a picture of the trajectory: room/rva-plot.png
"""
)
@run_argument
@click.argument("stage", required=False)
@click.option(
    "--rows", type=click.IntRange(min=0), help="How many rows of each table.  [default: 8 of step tables]"
)
@click.option(
    "--plot",
    is_flag=True,
    help="With rva, in place of its tables: draw the trajectory, scores, roles, weights and telling frames.",
)
@click.option(
    "-o",
    "--output",
    type=click.Path(dir_okay=False, path_type=Path),
    help=f"Picture of --plot (.png).  [default: RUN/{PLOT}]",
)
@json_option
@click.pass_obj
def show(
    dag: Dag,
    run: Path,
    stage: str | None,
    rows: int | None,
    plot: bool,
    output: Path | None,
    as_json: bool,
) -> None:
    """Show what the stages of RUN found, or the tables of one STAGE."""
    if plot and stage != "rva":
        raise InputError("--plot draws the stage rva", hint=f"cleargs show {run} rva --plot")
    if output is not None and (not plot or output.suffix.lower() != ".png"):
        raise InputError(
            "--output names the PNG of --plot", hint=f"cleargs show {run} rva --plot -o FILE.png"
        )
    if not (run / RUN_FILE).is_file():
        raise InputError(f"{run} is no run: it has no {RUN_FILE}", hint="give the folder of `cleargs run -o`")
    if stage is None:
        manifests = {name: linked_manifest(run, name) for name in dag.names}
        if as_json:
            print_json({name: _facts(manifest) for name, manifest in manifests.items()})
        else:
            _print_run(manifests)
        return
    dag.check(stage)
    manifest = linked_manifest(run, stage)
    if manifest is None:
        raise InputError(f"{stage} is not done in {run}", hint=f"see cleargs explain {run}")
    if plot:
        picture = _plot(run, manifest, output or run / PLOT)
        if as_json:
            print_json({"stage": stage, "plot": str(picture)})
        else:
            click.echo(f"written: {picture}")
        return
    tables = {
        name: _read(run / stage / name)
        for name in sorted(manifest.files)
        if name.endswith(".parquet") and "/" not in name
    }
    if as_json:
        shown = {
            name: {"rows": table.num_rows, "columns": describe_table(table)} for name, table in tables.items()
        }
        print_json({"stage": stage, **(_facts(manifest) or {}), "tables": shown})
        return
    console = _console()
    _print_facts(console, manifest)
    for name, table in tables.items():
        _print_columns(console, name, table)
        wanted = rows if rows is not None else 8 if "step" in table.column_names else 0
        if wanted and table.num_rows:
            _print_rows(console, table, wanted)


def _plot(run: Path, rva: Manifest, picture: Path) -> Path:
    """Draw RUN/rva with the poses and images that it was made from. Raises InputError, StoreError."""
    from cleargs.report.allocation import load_allocation, plot_allocation

    made_from, ingest = rva.parts.inputs["ingest"], linked_manifest(run, "ingest")
    if ingest is None or any(
        tree_digest(ingest.under(name)) != made_from[name] for name in ("frames.parquet", "images")
    ):
        raise InputError(
            f"rva was made from another ingest than the one in {run}",
            hint=f"run it again: cleargs stage rva {run}",
        )
    picture.parent.mkdir(parents=True, exist_ok=True)
    plot_allocation(picture, load_allocation(run / "rva", run / "ingest"), run.resolve().name)
    return picture


def _read(path: Path) -> Any:
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        return pq.read_table(path)
    except (OSError, pa.ArrowException) as error:
        raise InputError(
            f"cannot read {path}: {str(error).splitlines()[0]}",
            hint="run the same `cleargs run` command again",
        ) from error


def _facts(manifest: Manifest | None) -> dict[str, Any] | None:
    if manifest is None:
        return None
    return {
        "status": manifest.status,
        "missing": [*manifest.inherited, *manifest.missing],
        "key": manifest.key,
        "digest": manifest.digest,
        "started": manifest.started,
        "seconds": manifest.seconds,
        "device": manifest.device,
        "files": len(manifest.files),
        "bytes": manifest.bytes,
        "versions": {**manifest.versions, **manifest.parts.libraries},
        "summary": manifest.summary,
    }


# -- on the terminal ---------------------------------------------------------------------------------------


def _console() -> Console:
    from rich.console import Console

    return Console(highlight=False)


def _print_run(manifests: dict[str, Manifest | None]) -> None:
    from rich.table import Table

    table = Table("stage", "state", "seconds", "MB", "files", "figures", box=None, header_style="bold")
    for name, manifest in manifests.items():
        if manifest is None:
            table.add_row(name, "not done", "", "", "", "")
            continue
        figures = ", ".join(
            f"{label} {_text(value)}" for label, value in manifest.summary.items() if _is_figure(value)
        )
        size = f"{manifest.bytes / 1e6:.1f}"
        table.add_row(
            name, manifest.status, f"{manifest.seconds:.1f}", size, str(len(manifest.files)), figures
        )
    _console().print(table)


def _print_facts(console: Console, manifest: Manifest) -> None:
    from rich.table import Table

    table = Table(
        box=None, show_header=False, title=f"{manifest.stage}: {manifest.status}", title_justify="left"
    )
    for missing in (*manifest.inherited, *manifest.missing):
        table.add_row("missing", missing)
    for label, value in _flat(manifest.summary):
        table.add_row(label, _text(value))
    table.add_row("made in", f"{manifest.seconds:.1f} s on {manifest.device}, {manifest.started}")
    console.print(table)


def _print_columns(console: Console, name: str, data: Any) -> None:
    from rich.table import Table

    table = Table(
        "column",
        "min .. median .. max, or counts",
        "meaning",
        box=None,
        header_style="bold",
        title_justify="left",
    )
    table.title = f"\n{name}: {data.num_rows} rows"
    for column, facts in describe_table(data).items():
        table.add_row(column, _describe(facts), facts.get("meaning", ""))
    console.print(table)


def _print_rows(console: Console, data: Any, wanted: int) -> None:
    from rich.table import Table

    names = data.column_names
    table = Table(*names, box=None, header_style="bold")
    for row in sampled_rows(data, wanted):
        table.add_row(*(_text(row[name]) for name in names))
    console.print(table)


def _describe(facts: dict[str, Any]) -> str:
    if "counts" in facts:
        words = ", ".join(f"{value} {count}" for value, count in facts["counts"].items())
    elif "median" in facts:
        words = f"{_text(facts['min'])} .. {_text(facts['median'])} .. {_text(facts['max'])}"
    else:
        words = f"{facts['distinct']} different"
    return f"{words}, {facts['nulls']} empty" if facts["nulls"] else words


def _flat(value: Any, prefix: str = "") -> list[tuple[str, Any]]:
    """Nested figures as one list of ("outer.inner", value); the items of lists of tables count from 1."""
    if isinstance(value, dict):
        pairs = list(value.items())
    elif isinstance(value, list) and any(isinstance(item, dict) for item in value):
        pairs = [(str(number), item) for number, item in enumerate(value, 1)]
    else:
        return [(prefix, value)]
    return [row for label, item in pairs for row in _flat(item, f"{prefix}.{label}" if prefix else label)]


def _is_figure(value: Any) -> bool:
    return isinstance(value, (int, float, str)) and len(str(value)) <= 24


def _text(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, list):
        return ", ".join(_text(item) for item in value[:16]) + (" ..." if len(value) > 16 else "")
    return "" if value is None else str(value)
