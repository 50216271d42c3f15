"""``cleargs show``: tables and figures of a run in the terminal, and all facts about a frame."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict
from itertools import zip_longest
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Any

import click
from rich.console import Console
from rich.table import Table

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
from cleargs.cli.frame_rows import frame_rows, reason, score_text, short_name
from cleargs.cli.time_table import HEADS, time_rows
from cleargs.errors import InputError
from cleargs.manifest import Manifest
from cleargs.packed import WORKS, read_pack
from cleargs.parquet import meanings, read_any_table, read_table
from cleargs.pipeline.live import preview_of, running_stage
from cleargs.pipeline.outputs import check_outputs
from cleargs.pipeline.run_file import RunSpec, read_run_file
from cleargs.pipeline.stages import Stages
from cleargs.report.report_json import linked_manifests

if TYPE_CHECKING:
    from cleargs.report.frames import FrameRow

_NARROWEST = 24  # columns of a terminal that labels have at least
MAX_LISTED = 16  # items of a list that are printed
LAYERS_ACROSS, MAX_LAYER_WIDTH = 3, 640  # layout of the picture of a frame; width in px
HIDDEN = frozenset({"similarity", "holdout_hash", "round"})  # figures that only programs need

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
    "stand_in": "stand-ins for reliable frames",
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
        _show_frame(run, done, frame, None if read_pack(run) else picture, as_json)
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
            _print_table(time_rows(done), *HEADS)
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
    _print_table(rows, "stage", "state", "seconds", "MB", "files", "figures", wraps="figures")
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
    from cleargs.run_results import scene_path, scene_stage
    from cleargs.splat.ply import read_ply

    stage = scene_stage(dag, run, None)
    scene = read_ply(scene_path(run, stage))
    low, high = scene.gaussians.means.amin(0).tolist(), scene.gaussians.means.amax(0).tolist()
    facts = {"stage": stage, "gaussians": scene.gaussians.num, "low": low, "high": high}
    answer(as_json, facts, f"scene of {stage}: {scene.gaussians.num} Gaussians", extent_text(scene))


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
    _print_table(lines, title=f"{stage}: {manifest.status}")
    if frames is not None and not columns:
        click.echo()
        named = ((row | {"name": short_name(row["name"])}).items() for row in frames)
        config = manifest.parts.config
        cells = (
            [score_text(key, x, config) if isinstance(x, float) else text_of(x) for key, x in row]
            for row in named
        )
        _print_table(cells, *frames[0] if frames else (), wraps="reason")  # fits in 80 columns
    for name, fields in described.items() if columns else ():
        title = f"\n{name}: {tables[name].num_rows} rows"
        _print_table(fields, "column", "meaning", title=title, wraps="meaning")
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


def _show_frame(
    run: Path, done: Mapping[str, Manifest], number: int, picture: Path | None, as_json: bool
) -> None:
    """Write a picture of a frame's layers unless it is None, and print all facts about it (lines or JSON).

    Raises InputError if there is no such frame, StoreError if the picture cannot be written.
    """
    from cleargs.report.frames import MEANINGS, load_rows, worst_cue
    from cleargs.rivr.tables import REPAIRS
    from cleargs.scene.views import camera_of

    if "ingest" not in done:
        raise InputError(f"{run} has no frames yet", hint=f"see cleargs status {run}")
    rows = {row.frame.frame_id: row for row in load_rows(run, done)}
    if number not in rows:
        raise InputError(f"{run} has no frame {number}", hint=f"choose one from {min(rows)} to {max(rows)}")
    row = rows[number]
    frame, rated, repairs = row.frame, dict(row.rated), []
    if rated:
        rated |= {"reason": reason(rated, done["rva"].parts.config), "worst_cue": worst_cue(rated)}
    if "consolidate" in done:
        repairs = read_table(run / "consolidate/repairs.parquet", REPAIRS).to_pylist()
    formation = row.formation.items()
    facts = {
        **asdict(frame),
        "centre": camera_of(frame).centre.tolist() if frame.registered else None,
        "rva": rated or None,
        "exposure_stops": row.gain_ev,
        "formation": {name: {"value": value, "meaning": MEANINGS.get(name, "")} for name, value in formation},
        "rounds": [asdict(found) for found in row.rounds],
        "distilled": next((line for line in repairs if line["frame_id"] == number), None),
        "layers": [] if picture is None else _write_layers(picture, run, done, row),
        "picture": None if picture is None else str(picture),
    }
    if not as_json:
        config = done["rva"].parts.config if rated else {}
        _print_table(_lines(row, facts, config), title=f"frame {number}")
    answer(as_json, facts, f"written: {picture}" if picture else "no picture: a packed run has no images")


def _write_layers(path: Path, run: Path, stages: Collection[str], row: FrameRow) -> list[str]:
    """Write the layers of a frame side by side with labels, as a PNG. Return their names.

    They are the raw frame, the layers of its latest round or image formation, and the last scene at its pose.
    """
    from cleargs.media.contact_sheet import Tile, contact_sheet
    from cleargs.media.image import write_rgb
    from cleargs.report.frames import last_scene, scene_with_models
    from cleargs.report.pictures import LAYERS, formed_layers, layers_of
    from cleargs.scene.folder import SceneFolder
    from cleargs.scene.views import camera_of
    from cleargs.splat.render import Viewer

    images, scene = layers_of(row, run), last_scene(stages)
    images |= formed_layers(row, run, scene_with_models([row], run, stages))
    if scene is not None and row.frame.registered:
        images["final"] = Viewer(SceneFolder(run / scene).scene()).view(camera_of(row.frame), row.affine)
    shown = [name for name in dict.fromkeys((*LAYERS, *images)) if name in images]
    labels = {name: LAYERS.get(name, name) + (" (chosen)" if name == row.chosen else "") for name in shown}
    tiles = [Tile(images[name], labels[name], marked=name == row.chosen) for name in shown]
    lines = [tiles[start : start + LAYERS_ACROSS] for start in range(0, len(tiles), LAYERS_ACROSS)]
    path.parent.mkdir(parents=True, exist_ok=True)
    write_rgb(path, contact_sheet(lines, tile_width=min(MAX_LAYER_WIDTH, max(240, row.frame.width))))
    return shown


def _lines(row: FrameRow, facts: Mapping[str, Any], settings: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """Yield label and text of each line about a frame; ``settings`` of RVA. ``--json`` prints more facts."""
    from cleargs.report.frames import EFFECTS, scores_of
    from cleargs.rivr.candidates import phrase_of

    frame, rated = row.frame, facts["rva"]
    if row.weight_text:
        yield "counts", row.weight_text
    yield "file", frame.name
    if frame.time_s is not None:
        yield "time", f"{frame.time_s:.2f} s"
    if frame.split == "test":
        yield "held out", "for testing; no training uses it"
    if frame.registered:
        centre = ", ".join(f"{value:.3f}" for value in facts["centre"])
        yield "pose", f"camera at ({centre}), sees {frame.n_points} sparse points"
        if frame.kept_out_share is not None:
            figure = f"{frame.kept_out_share:.0%} within 2 px, median {frame.kept_out_px:.2f} px"
            yield "kept out", f"{frame.kept_out_keypoints} keypoints that no fit used: {figure}"
    else:
        yield "pose", f"none found: {frame.placed}" if frame.placed else "none found"
    if rated:
        yield "role by RVA", f"{rated['role']}, weight {rated['weight']:.2f}: {rated['reason']}"
        known = ((name, rated[name]) for name in ("R", "B", "G") if rated[name] is not None)
        yield "scores", ", ".join(f"{name} {score_text(name, value, settings)}" for name, value in known)
        yield "worst cue", rated["worst_cue"] or "none"
    if found := row.formation:
        if found["model"] == "none":
            yield "formation", "nothing found"
        else:
            model = EFFECTS[found["model"]][0]
            lengths = {"blur": "blur_px", "rolling shutter": "skew_px", "defocus": "defocus_px"}
            sizes = ", ".join(f"{label} {found[name]:.2f} px" for label, name in lengths.items())
            yield "formation", f"{model}, explains {100 * found['explained']:.0f} % of the misfit; {sizes}"
        before, after = found["weight_before"], found["weight_after"]
        yield "weight", f"{before:.2f} before image formation, {after:.2f} after it"
    for choice in row.rounds:
        refused = ", refused" if not choice.accepted and choice.chosen != "observed" else ""
        yield f"round {choice.round}", f"{phrase_of(choice.chosen)}{refused} ({choice.reason})"
        for metric, scores in scores_of(choice):
            yield "", f"{metric}: " + ", ".join(f"{name} {score:.1f}" for name, score in scores.items())
    if repair := facts["distilled"]:
        yield "final scene", f"trained on {phrase_of(repair['chosen'])} of round {repair['round']}"


def _print_table(rows: Iterable[Sequence[str]], *columns: str, title: str = "", wraps: str = "") -> None:
    """Print a table without rules. ``columns`` are its heads; without heads, the first column has labels.

    Labels wrap before values do. Only the column with the head ``wraps`` may wrap. With ``wraps`` the columns
    are closer together. Nothing is cut: lines may be longer than the terminal.
    Brackets in cells are not treated as markup.
    """
    rows, console = list(rows), Console(highlight=False, markup=False, emoji=False)
    gap = (0, 1 if wraps else 2, 0, 0)
    table = Table(*columns, box=None, header_style="bold", padding=gap, pad_edge=False)
    table.title, table.title_justify, table.show_header = title or None, "left", bool(columns)
    if not columns:
        longest = max((len(value) for _, value in rows), default=0)
        table.add_column(max_width=max(_NARROWEST, console.width - 2 - longest))
    for column in table.columns:
        column.overflow = "fold"
        column.no_wrap |= bool(wraps) and column.header != wraps
        column.min_width = 14 if column.header == wraps else None
    for row in rows:
        table.add_row(*row)
    least = [
        max(len(part) for text in cells for part in ([text] if column.no_wrap else text.split() or [""]))
        for column, cells in zip(table.columns, zip_longest(*rows, columns, fillvalue=""), strict=True)
    ]
    least = [max(width, column.min_width or 0) for width, column in zip(least, table.columns, strict=True)]
    console.width = max(console.width, sum(least) + gap[1] * (len(least) - 1))
    console.print(table)
