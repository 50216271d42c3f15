"""``cleargs show``: the tables and figures of a run in the terminal."""

from __future__ import annotations

from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Any, Literal

import click

from cleargs.cli.common import json_option, print_json, run_argument
from cleargs.cli.frame_reasons import COLUMNS, frame_rows, short_name
from cleargs.cli.manifest_words import headlines, in_words, text_of
from cleargs.cli.summary import describe_table, sampled_rows
from cleargs.errors import InputError
from cleargs.manifest import Manifest, linked_manifest
from cleargs.pipeline.dag import Dag
from cleargs.pipeline.live import at_work, preview_of
from cleargs.pipeline.run_file import Run, read_run_file

if TYPE_CHECKING:
    from rich.console import Console

WIDEST = 8
"""A table of more columns is shown with its rows beside each other."""

PLOT = "rva-plot.png"
"""The picture of ``--plot`` in the run's folder, unless another is named."""


@click.command(
    epilog="""\b
Examples:
  cleargs show room                 all stages: state, time, size, figures
  cleargs show room rva             what became of every frame, and why
  cleargs show room rva --columns   what the tables hold, column by column
  cleargs show room g0 --rows 5     rows of each table, evenly spread
  cleargs show room rva --plot      a picture of the trajectory: room/rva-plot.png
  cleargs show room --frame 3       all about one frame, and its layers: room/frame-000003.png
"""
)
@run_argument
@click.argument("stage", required=False)
@click.option(
    "--rows", type=click.IntRange(min=0), help="How many rows of each table.  [default: 8 of step tables]"
)
@click.option("--columns", is_flag=True, help="Describe the tables column by column.")
@click.option(
    "--plot",
    is_flag=True,
    help="With rva, instead of its tables: draw trajectory, scores, roles, weights, best and worst frames.",
)
@click.option(
    "--frame",
    type=click.IntRange(min=0),
    metavar="N",
    help="In place of tables: all about frame N, with a picture of its layers side by side.",
)
@click.option(
    "-o",
    "--output",
    type=click.Path(dir_okay=False, path_type=Path),
    help=f"Picture of --plot or --frame (.png).  [default: RUN/{PLOT}, RUN/frame-N.png]",
)
@json_option
@click.pass_obj
def show(
    dag: Dag,
    run: Path,
    stage: str | None,
    rows: int | None,
    columns: bool,
    plot: bool,
    frame: int | None,
    output: Path | None,
    as_json: bool,
) -> None:
    """Show what the stages of RUN found, or the tables of one STAGE."""
    if plot and stage != "rva":
        raise InputError("--plot draws the stage rva", hint=f"cleargs show {run} rva --plot")
    if frame is not None and stage is not None:
        raise InputError("--frame is about all stages", hint=f"cleargs show {run} --frame {frame}")
    if stage is None and (columns or rows is not None):
        raise InputError(
            "--rows and --columns are about the tables of a stage", hint=f"cleargs show {run} rva --columns"
        )
    pictured = plot or frame is not None
    if output is not None and (not pictured or output.suffix.lower() != ".png"):
        raise InputError(
            "--output names the PNG of --plot or --frame", hint=f"cleargs show {run} rva --plot -o FILE.png"
        )
    if frame is not None:
        _show_frame(dag, run, frame, output or run / f"frame-{frame:06d}.png", as_json)
        return
    settings = read_run_file(run, dag)
    if stage is None:
        manifests = {name: linked_manifest(run, name) for name in dag.names}
        if as_json:
            print_json({name: _facts(manifest) for name, manifest in manifests.items()})
        else:
            _print_run(manifests)
            _print_work(settings)
        return
    dag.check(stage)
    manifest = linked_manifest(run, stage)
    if manifest is None:
        raise InputError(f"{stage} is not done in {run}", hint=f"see cleargs status {run}")
    if plot:
        picture = _plot(run, output or run / PLOT)
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
    frames = None
    if stage == "rva":
        rivr = run / "rivr" / "selection.parquet"
        repairs = _read(rivr).to_pylist() if rivr.is_file() else None
        frames = frame_rows(tables["frames.parquet"].to_pylist(), manifest.parts.config, repairs)
    if as_json:
        shown = {
            name: {"rows": table.num_rows, "columns": describe_table(table)} for name, table in tables.items()
        }
        facts = {"stage": stage, **(_facts(manifest) or {}), "tables": shown}
        print_json(facts if frames is None else {**facts, "frames": frames})
        return
    console = _console()
    _print_facts(console, manifest)
    if frames is not None and not columns and rows is None:
        _print_frames(console, frames)
        return
    for name, table in tables.items():
        wanted = rows if rows is not None else 8 if "step" in table.column_names and not columns else 0
        if columns:
            _print_columns(console, name, table)
        elif wanted and table.num_rows:
            console.print(f"\n{name}: {table.num_rows} rows")
        if wanted and table.num_rows:
            _print_rows(console, table, wanted)
    if not columns:
        console.print(f"\nevery column: cleargs show {quote(str(run))} {stage} --columns")


def _show_frame(dag: Dag, run: Path, frame: int, picture: Path, as_json: bool) -> None:
    """Print all about one frame, and write the picture of its layers. Raises InputError, StoreError."""
    from cleargs.cli.show_frame import frame_facts, frame_row, in_lines, write_layers

    made = {name: found for name in dag.names if (found := linked_manifest(run, name)) is not None}
    if "ingest" not in made:
        raise InputError(f"{run} has no frames yet", hint=f"see cleargs status {run}")
    row = frame_row(run, made, frame)
    facts = frame_facts(run, made, row, made["rva"].parts.config if "rva" in made else {})
    layers = write_layers(picture, run, made, row)
    if as_json:
        print_json({**facts, "layers": layers, "picture": str(picture)})
        return
    from rich.table import Table
    from rich.text import Text

    table = Table(box=None, show_header=False, title=f"frame {frame}", title_justify="left")
    table.add_column(no_wrap=True)
    for label, text in in_lines(facts, run):
        table.add_row(label, Text(text))
    _console().print(table)
    click.echo(f"written: {picture}")


def _plot(run: Path, picture: Path) -> Path:
    """Draw RUN/rva with the poses and images that it was made from. Raises InputError, StoreError."""
    from cleargs.report.allocation_picture import load_allocation, plot_allocation

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

    return Console(highlight=False, markup=False)  # names may hold brackets


def _print_run(manifests: dict[str, Manifest | None]) -> None:
    from rich.table import Table

    table = Table("stage", "state", "seconds", "MB", "files", "figures", box=None, header_style="bold")
    for name, manifest in manifests.items():
        if manifest is None:
            table.add_row(name, "not done", "", "", "", "")
            continue
        cells = (f"{manifest.seconds:.1f}", f"{manifest.bytes / 1e6:.1f}", str(len(manifest.files)))
        table.add_row(name, manifest.status, *cells, headlines(manifest.summary))
    _console().print(table)


def _print_work(run: Run) -> None:
    """What the run does now, and where the picture of it lies."""
    found = at_work(run.folder, run.store)
    if found is None:
        return
    count = f"{found.done} of {found.total}" if found.total else str(found.done or "")
    words = ", ".join(filter(None, (found.label, count, found.note)))
    console, preview = _console(), preview_of(found, run.store)
    console.print(f"\n{found.stage} is at work: {words}")
    if preview is not None:
        console.print(f"preview: {preview.path}", soft_wrap=True)


def _print_facts(console: Console, manifest: Manifest) -> None:
    from rich.table import Table

    table = Table(
        box=None, show_header=False, title=f"{manifest.stage}: {manifest.status}", title_justify="left"
    )
    for missing in (*manifest.inherited, *manifest.missing):
        table.add_row("missing", missing)
    for label, text in in_words(manifest.summary):
        table.add_row(label, text)
    table.add_row("made in", f"{manifest.seconds:.1f} s on {manifest.device}, {manifest.started}")
    console.print(table)


def _print_frames(console: Console, frames: list[dict[str, Any]]) -> None:
    from rich.table import Table

    table = Table(box=None, header_style="bold", padding=(0, 1, 0, 0), pad_edge=False)
    numbers = ("frame", "weight", "R", "B")
    for name in COLUMNS:
        if frames and name in frames[0]:
            justify: Literal["right", "left"] = "right" if name in numbers else "left"
            table.add_column(name, justify=justify, no_wrap=name != "reason", overflow="fold")
    for row in frames:
        values = (row | {"name": short_name(row["name"])}).values()
        table.add_row(*(f"{value:.2f}" if isinstance(value, float) else text_of(value) for value in values))
    console.print()
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
    rows = sampled_rows(data, wanted)
    if len(names) <= WIDEST:
        table = Table(*names, box=None, header_style="bold")
        for row in rows:
            table.add_row(*(text_of(row[name]) for name in names))
    else:
        table = Table(box=None, show_header=False)
        table.add_column(no_wrap=True)
        for name in names:
            table.add_row(name, *(text_of(row[name]) for row in rows))
    console.print(table)


def _describe(facts: dict[str, Any]) -> str:
    if "counts" in facts:
        words = ", ".join(f"{value} {count}" for value, count in facts["counts"].items())
    elif "median" in facts:
        words = f"{text_of(facts['min'])} .. {text_of(facts['median'])} .. {text_of(facts['max'])}"
    else:
        words = f"{facts['distinct']} different"
    return f"{words}, {facts['nulls']} empty" if facts["nulls"] else words
