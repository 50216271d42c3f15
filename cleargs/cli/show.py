"""``cleargs show``: tables and figures of a run in the terminal, and all facts about a frame."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from shlex import quote
from typing import Any

import click

from cleargs.cli.commands import as_called
from cleargs.cli.common import (
    FILE,
    answer,
    complete_stage,
    json_option,
    manifest_json,
    print_json,
    run_argument,
)
from cleargs.cli.frame_rows import frame_rows, score_text, short_name
from cleargs.cli.show_frame import show_frame
from cleargs.cli.terminal_table import print_table
from cleargs.cli.time_table import HEADS, time_rows
from cleargs.errors import InputError
from cleargs.manifest import Manifest
from cleargs.packed import WORKS, read_pack
from cleargs.parquet import meanings, read_any_table
from cleargs.pipeline.live import preview_of, running_stage
from cleargs.pipeline.outputs import check_outputs
from cleargs.pipeline.run_file import RunSpec, read_run_file
from cleargs.pipeline.stages import Stages
from cleargs.report.report_json import linked_manifests

MAX_LISTED = 16  # items of a list that are printed
HIDDEN = frozenset({"holdout_hash", "round"})  # figures that only programs need

LABELS: Mapping[str, str] = {
    "registered": "frames with a pose",
    "test": "frames held out for testing",
    "given_poses_missed_px": "median reprojection error at the given poses, px",
    "pose_convention": "convention of the given poses",
    "kept_out_matches_off_px": "median error of matches that the fit did not use, by origin of the poses, px",
    "kept_out": "keypoints that no fit used",
    "keypoints": "keypoints",
    "share": "share within 2 px",
    "median_px": "median distance, px",
    "focal_px": "focal length, px",
    "focal_range_px": "shortest and longest focal length, px",
    "fallback": "frames in place of reliable ones",
    "focal_range_in": "frames with these",
    "named": "frames of this camera",
    "effective_frames": "effective number of frames",
    "bins": "sections of the trajectory",
    "bins_uncovered_before": "sections without a usable frame at first",
    "psnr_strong": "training PSNR of the strong frames, dB",
    "psnr_active": "training PSNR, dB",
    "psnr_unseen": "PSNR of pixels that no training saw, dB",
    "psnr_before": "PSNR in the first scene, dB",
    "psnr_after": "PSNR now, dB",
    "repairs_refused": "repairs refused by the gate",
    "tie_breaks": "choices by the tie-break scorer",
    "latest_rounds": "repairs by round",
    "control": "control frames",
}
"""Figure of a manifest -> its label, if its name is not clear."""

OVERVIEW = ("frames", "registered", "test", "points", "roles", "gaussians", "psnr_unseen", "repairs")
"""Figures in the overview of a run, which also names the ``published`` scene."""


@click.command(
    epilog="""\b
Examples:
  cleargs show room                 all stages: state, time, size, figures
  cleargs show room rva             role and weight of each frame, and why
  cleargs show room rva --columns   the columns of the tables, with their meanings
  cleargs show room time            where the time of each stage went
  cleargs show room scene           the box that holds the scene, for export --crop
  cleargs show room --frame 3       all facts about a frame, and its layers: room/frame-000003.png
"""
)
@run_argument
@click.argument("stage", required=False, shell_complete=complete_stage)
@click.option("--columns", is_flag=True, help="List the columns of the tables, with their meanings.")
@click.option(
    "--frame",
    type=click.IntRange(min=0),
    metavar="N",
    help="Show all facts about frame N, and write a picture of its layers.",
)
@click.option("-o", "--output", type=FILE, help="File of --frame (.png).  [default: RUN/frame-N.png]")
@click.option("--force", is_flag=True, help="Replace an existing file of --output.")
@json_option
@click.pass_obj
def show(
    dag: Stages,
    run: Path,
    stage: str | None,
    columns: bool,
    frame: int | None,
    output: Path | None,
    force: bool,
    as_json: bool,
) -> None:
    """Show the results of the stages of RUN, or the tables of one STAGE."""
    draws = output is not None and output.suffix.lower() == ".png" and frame is not None
    for cause, wrong, example in (
        ("--frame cannot be used with a stage", frame is not None and stage is not None, f"--frame {frame}"),
        ("--columns needs the name of a stage", stage is None and columns, "rva --columns"),
        ("--output needs --frame, and a .png file", output and not draws, "--frame 3 -o FILE.png"),
    ):
        if wrong:
            raise InputError(cause, hint=f"cleargs show {run} {example}")
    settings = read_run_file(run, dag)
    done = linked_manifests(run, dag.names)
    if frame is not None:
        picture = output or run / f"frame-{frame:06d}.png"
        check_outputs([picture], dag, run, force=force or output is None)
        show_frame(run, done, frame, None if read_pack(run) else picture, as_json)
    elif stage is None:
        if as_json:
            print_json({name: manifest_json(done[name]) if name in done else None for name in dag.names})
        else:
            _print_run(settings, {name: done.get(name) for name in settings.stages(dag)})
    elif stage == "scene":
        _show_extent(dag, run, as_json)
    elif stage == "time":
        if as_json:
            print_json({name: [one.model_dump() for one in done[name].timing] for name in done})
        else:
            print_table(time_rows(done), *HEADS)
    elif dag.check(stage) not in done:
        raise InputError(f"{stage} is not done in {run}", hint=f"see cleargs status {run}")
    else:
        _show_stage(run, done, stage, columns, as_json)


def _print_run(run: RunSpec, manifests: Mapping[str, Manifest | None]) -> None:
    """Print one line per stage, then the running stage with its preview."""
    rows = []
    for name, manifest in manifests.items():
        if manifest is None:
            rows.append([name, "not done"])
            continue
        cells = (f"{manifest.seconds:.1f}", f"{manifest.bytes / 1e6:.1f}", str(len(manifest.files)))
        found = manifest.summary
        chosen = {key: found[key] for key in (*OVERVIEW, "published") if key in found} or found
        text = ", ".join(f"{label} {value}" for label, value in labelled(chosen))
        rows.append([name, manifest.status, *cells, text])
    print_table(rows, "stage", "state", "seconds", "MB", "files", "figures", wraps="figures")
    if read_pack(run.folder):
        click.echo(f"packed run: {WORKS}")
    elif None in manifests.values():
        click.echo(as_called(f"not done: see cleargs status {quote(str(run.folder))}"))
    if work := running_stage(run.folder, run.store):
        click.echo(f"\n{work.stage} is running: {work.words}")
        if preview := preview_of(work, run.store):
            click.echo(f"preview: {preview.path}")


def _show_extent(dag: Stages, run: Path, as_json: bool) -> None:
    """Print the scene's box, in the coordinates of the exports that turn nothing."""
    from cleargs.render.pruning import extent_text
    from cleargs.run_results import scene_origin, scene_path, scene_stage
    from cleargs.splat.ply import read_ply

    stage = scene_stage(dag, run, None)
    scene = read_ply(scene_path(run, stage))
    low, high = scene.gaussians.means.amin(0).tolist(), scene.gaussians.means.amax(0).tolist()
    facts = {"stage": stage, "gaussians": scene.gaussians.num, "low": low, "high": high}
    origin = scene_origin(dag, run, stage)
    answer(as_json, facts, f"scene of {origin}: {scene.gaussians.num} Gaussians", extent_text(scene))


def _show_stage(run: Path, done: Mapping[str, Manifest], stage: str, columns: bool, as_json: bool) -> None:
    """Print the figures of a stage, then the columns of its tables if ``columns``, else (RVA) its frames."""
    manifest = done[stage]
    names = [name for name in sorted(manifest.files) if name.endswith(".parquet") and "/" not in name]
    tables = {name: read_any_table(run / stage / name) for name in names}
    frames = None
    if stage == "rva":
        repairs = read_any_table(run / "rivr" / "selection.parquet").to_pylist() if "rivr" in done else None
        frames = frame_rows(tables["frames.parquet"].to_pylist(), manifest.parts.config, repairs)
    described = {name: list(meanings(table.schema).items()) for name, table in tables.items()}
    if as_json:
        facts = {
            name: {"rows": tables[name].num_rows, "columns": dict(fields)}
            for name, fields in described.items()
        }
        shown = {} if frames is None else {"frames": frames}
        print_json({"stage": stage, **manifest_json(manifest), "tables": facts, **shown})
        return
    lines = [("missing", missing) for missing in (*manifest.inherited, *manifest.missing)]
    lines += labelled(manifest.summary)
    lines.append(("time", f"{manifest.seconds:.1f} s on {manifest.device}, started {manifest.started}"))
    print_table(lines, title=f"{stage}: {manifest.status}")
    if frames is not None and not columns:
        click.echo()
        named = ((row | {"name": short_name(row["name"])}).items() for row in frames)
        config = manifest.parts.config
        cells = (
            [score_text(key, x, config) if isinstance(x, float) else text_of(x) for key, x in row]
            for row in named
        )
        print_table(cells, *frames[0] if frames else (), wraps="reason")  # fits in 80 columns
    for name, fields in described.items() if columns else ():
        title = f"\n{name}: {tables[name].num_rows} rows"
        print_table(fields, "column", "meaning", title=title, wraps="meaning")
    if not columns:
        click.echo(as_called(f"\nall columns: cleargs show {quote(str(run))} {stage} --columns"))


def labelled(summary: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, str]]:
    """Yield label and text of each figure. Numbers of one kind share a line; other nested figures do not."""
    for name, value in summary.items():
        label = prefix + LABELS.get(name, name.replace("_", " "))
        if name in HIDDEN:
            continue
        if name in ("weights", "latest_rounds"):
            word = "from" if name == "weights" else "in round"
            yield label, ", ".join(f"{count} {word} {item}" for item, count in value.items() if count)
        elif name == "harm":
            yield label, value or "none"
        elif isinstance(value, Mapping) and any(
            key in LABELS or isinstance(item, Mapping | list) for key, item in value.items()
        ):
            yield from labelled(value, f"{label}: ")
        elif isinstance(value, list) and value and isinstance(value[0], Mapping):
            for number, item in enumerate(value, 1):
                yield from labelled(item, f"{'camera' if name == 'cameras' else 'round'} {number}: ")
        elif text := text_of(value):
            yield label, text


def text_of(value: Any) -> str:
    """Return a value as text: numbers with four digits, "yes" or "no", counts as "9 restored, 3 render"."""
    match value:
        case None:
            return ""
        case bool():
            return "yes" if value else "no"
        case float():
            return f"{value:.4g}"
        case list():
            return ", ".join(map(text_of, value[:MAX_LISTED])) + (" ..." if len(value) > MAX_LISTED else "")
        case Mapping():
            names = {name: name.replace("_", " ").replace("observed", "as filmed") for name in value}
            if not all(isinstance(item, int) for item in value.values()):
                return ", ".join(f"{names[name]} {text_of(item)}" for name, item in value.items())
            return ", ".join(f"{count} {names[name]}" for name, count in value.items() if count) or "none"
    return str(value)
