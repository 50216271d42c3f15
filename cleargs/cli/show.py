"""``cleargs show``: the tables and figures of a run in the terminal."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Any

import click

from cleargs.cli.common import json_option, print_json, run_argument
from cleargs.cli.tables import labelled, line_table, new_table, print_table, text_of
from cleargs.errors import InputError
from cleargs.manifest import Manifest, linked_manifest
from cleargs.pipeline.dag import Dag
from cleargs.pipeline.live import at_work, preview_of
from cleargs.pipeline.run_file import Run, read_run_file

if TYPE_CHECKING:
    import pyarrow as pa
    from rich.table import Table

PLOT = "rva-plot.png"
"""The picture of ``--plot`` in the run's folder, unless another is named."""

MAX_COUNTED = 12
"""A column of words with more different values than this is not counted value by value."""

HEADLINES = (
    "frames",
    "registered",
    "test",
    "points",
    "roles",
    "gaussians",
    "psnr_unseen",
    "repairs",
    "published",
)
"""Figures that the overview of a run shows."""


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
    settings = read_run_file(run, dag)
    manifests = {name: linked_manifest(run, name) for name in dag.names}
    done = {name: manifest for name, manifest in manifests.items() if manifest is not None}
    if frame is not None:
        from cleargs.cli.show_frame import show_frame

        show_frame(run, done, frame, output or run / f"frame-{frame:06d}.png", as_json)
    elif stage is None:
        if as_json:
            print_json({name: manifest and _facts(manifest) for name, manifest in manifests.items()})
        else:
            _print_run(settings, manifests)
    elif dag.check(stage) not in done:
        raise InputError(f"{stage} is not done in {run}", hint=f"see cleargs status {run}")
    elif plot:
        from cleargs.report.allocation_picture import plot_allocation

        picture = output or run / PLOT
        plot_allocation(picture, run / "rva", run / "ingest", run.resolve().name)
        if as_json:
            print_json({"stage": stage, "plot": str(picture)})
        else:
            click.echo(f"written: {picture}")
    else:
        _show_stage(run, done, stage, rows, columns, as_json)


def _facts(manifest: Manifest) -> dict[str, Any]:
    """The state of a stage as JSON values."""
    names = ("status", "key", "digest", "started", "seconds", "device", "summary")
    return {
        **{name: getattr(manifest, name) for name in names},
        "missing": [*manifest.inherited, *manifest.missing],
        "files": len(manifest.files),
        "bytes": manifest.bytes,
        "versions": {**manifest.versions, **manifest.parts.libraries},
    }


def _print_run(run: Run, manifests: Mapping[str, Manifest | None]) -> None:
    """Print a line per stage, and the present work with its preview."""
    table = new_table("stage", "state", "seconds", "MB", "files", "figures")
    for name, manifest in manifests.items():
        if manifest is None:
            table.add_row(name, "not done")
            continue
        cells = (f"{manifest.seconds:.1f}", f"{manifest.bytes / 1e6:.1f}", str(len(manifest.files)))
        found = manifest.summary
        chosen = {key: found[key] for key in HEADLINES if key in found} or found
        text = ", ".join(f"{label} {value}" for label, value in labelled(chosen))
        table.add_row(name, manifest.status, *cells, text)
    print_table(table)
    if None in manifests.values():
        click.echo(f"not done: see cleargs status {quote(str(run.folder))}")
    if work := at_work(run.folder, run.store):
        count = f"{work.done} of {work.total}" if work.total else str(work.done or "")
        click.echo(f"\n{work.stage} is at work: {', '.join(filter(None, (work.label, count, work.note)))}")
        if preview := preview_of(work, run.store):
            click.echo(f"preview: {preview.path}")


def _show_stage(
    run: Path, done: Mapping[str, Manifest], stage: str, rows: int | None, columns: bool, as_json: bool
) -> None:
    """Print the figures of a stage, and its tables as far as they are asked for."""
    manifest = done[stage]
    names = [name for name in sorted(manifest.files) if name.endswith(".parquet") and "/" not in name]
    tables = {name: _read(run / stage / name) for name in names}
    frames = None
    if stage == "rva":
        from cleargs.cli.show_frame import frame_rows, short_name

        repairs = _read(run / "rivr" / "selection.parquet").to_pylist() if "rivr" in done else None
        frames = frame_rows(tables["frames.parquet"].to_pylist(), manifest.parts.config, repairs)
    if as_json:
        described = {
            name: {"rows": data.num_rows, "columns": describe_table(data)} for name, data in tables.items()
        }
        shown = {} if frames is None else {"frames": frames}
        print_json({"stage": stage, **_facts(manifest), "tables": described, **shown})
        return
    lines = [("missing", missing) for missing in (*manifest.inherited, *manifest.missing)]
    lines += labelled(manifest.summary)
    lines.append(("made in", f"{manifest.seconds:.1f} s on {manifest.device}, {manifest.started}"))
    print_table(line_table(f"{stage}: {manifest.status}", lines))
    if frames is not None and not columns and rows is None:
        click.echo()
        table = new_table(*frames[0] if frames else ())
        table.padding = (0, 1, 0, 0)  # all fits on 80 columns
        for column in table.columns:
            column.no_wrap = column.header != "reason"
        for row in frames:
            values = (row | {"name": short_name(row["name"])}).values()
            table.add_row(
                *(f"{value:.2f}" if isinstance(value, float) else text_of(value) for value in values)
            )
        print_table(table)
        return
    for name, data in tables.items():
        wanted = rows if rows is not None else 8 if "step" in data.column_names and not columns else 0
        title = f"{name}: {data.num_rows} rows"
        if columns:
            print_table(_column_table(title, data))
        if wanted and data.num_rows:
            print_table(_row_table("" if columns else title, data, wanted))
    if not columns:
        click.echo(f"\nevery column: cleargs show {quote(str(run))} {stage} --columns")


def _read(path: Path) -> pa.Table:
    """Return a table of any columns. Raises StoreError when it cannot be read."""
    import pyarrow.parquet as pq

    from cleargs.parquet import damage_told

    with damage_told(path):
        return pq.read_table(path)


def describe_table(table: pa.Table) -> dict[str, dict[str, Any]]:
    """Column -> its meaning (from the field's metadata), nulls, and figures that suit its type.

    Words and booleans: ``counts`` of each value, most frequent first (``distinct`` where there are many, or
    where every row has its own).
    Numbers: ``min``, ``median``, ``mean``, ``max`` over the values that are neither null nor NaN.
    """
    import pyarrow as pa
    import pyarrow.compute as pc

    described: dict[str, dict[str, Any]] = {}
    for field in table.schema:
        facts: dict[str, Any] = {"type": str(field.type), "nulls": table[field.name].null_count}
        if meaning := (field.metadata or {}).get(b"meaning"):
            facts["meaning"] = meaning.decode()
        values = table[field.name].drop_null()
        if pa.types.is_integer(field.type) or pa.types.is_floating(field.type):
            finite = values.filter(pc.is_finite(values))
            if len(finite):
                facts |= pc.min_max(finite).as_py()
                facts |= {"median": pc.quantile(finite, q=0.5)[0].as_py(), "mean": pc.mean(finite).as_py()}
            else:
                facts["distinct"] = 0
        else:
            counts = Counter(map(_word, values.to_pylist()))
            if len(counts) > MAX_COUNTED or 2 < len(counts) == len(values) or pa.types.is_list(field.type):
                facts["distinct"] = len(counts)
            else:
                facts["counts"] = dict(sorted(counts.items(), key=lambda item: (-item[1], item[0])))
        described[field.name] = facts
    return described


def _word(value: Any) -> str:
    return str(value).lower() if isinstance(value, bool) else str(value)


def sampled_rows(table: pa.Table, wanted: int) -> list[dict[str, Any]]:
    """``wanted`` rows (at most), evenly spread, the first and the last among them; the last for one."""
    last = table.num_rows - 1
    steps = min(wanted, table.num_rows) - 1
    rows: list[dict[str, Any]] = table.take(
        [round(index * last / steps) for index in range(steps + 1)] if steps > 0 else [last]
    ).to_pylist()
    return rows


# -- on the terminal -----------------------------------------------------------------------------------------


def _column_table(title: str, data: pa.Table) -> Table:
    table = new_table("column", "min .. median .. max, or counts", "meaning", title=f"\n{title}")
    for column, facts in describe_table(data).items():
        if "counts" in facts:
            words = ", ".join(f"{value} {count}" for value, count in facts["counts"].items())
        elif "median" in facts:
            words = " .. ".join(text_of(facts[name]) for name in ("min", "median", "max"))
        else:
            words = f"{facts['distinct']} different"
        empty = f", {facts['nulls']} empty" if facts["nulls"] else ""
        table.add_row(column, words + empty, facts.get("meaning", ""))
    return table


def _row_table(title: str, data: pa.Table, wanted: int) -> Table:
    """Some rows of a table, one per column of the terminal."""
    rows = [[text_of(value) for value in row.values()] for row in sampled_rows(data, wanted)]
    table = new_table(title=title and f"\n{title}")
    for line in zip(data.column_names, *rows, strict=True):
        table.add_row(*line)
    return table
