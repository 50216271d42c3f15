"""All facts about a frame, for ``cleargs show --frame``: lines, and a picture of its layers."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cleargs.cli.common import answer
from cleargs.cli.frame_rows import reason, score_text
from cleargs.cli.terminal_table import print_table
from cleargs.errors import InputError
from cleargs.manifest import Manifest
from cleargs.parquet import read_table

if TYPE_CHECKING:
    from cleargs.report.frames import FrameRow


def show_frame(
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
        print_table(_lines(row, facts, config), title=f"frame {number}")
    answer(as_json, facts, f"written: {picture}" if picture else "no picture: a packed run has no images")


LAYERS_ACROSS, MAX_LAYER_WIDTH = 3, 640  # layout of the picture of a frame; width in px


def _write_layers(path: Path, run: Path, stages: Collection[str], row: FrameRow) -> list[str]:
    """Write the layers of a frame side by side with labels, as a PNG. Return their names.

    They are the frame image, layers of its latest round or image formation, and the last scene at its pose.
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
        yield "training", row.weight_text
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
            yield "formation", f"{model}, explains {100 * found['explained']:.0f} % of the residual; {sizes}"
        before, after = found["weight_before"], found["weight_after"]
        yield "weight", f"{before:.2f} before image formation, {after:.2f} after it"
    for choice in row.rounds:
        refused = ", refused" if not choice.accepted and choice.chosen != "observed" else ""
        yield f"round {choice.round}", f"{phrase_of(choice.chosen)}{refused} ({choice.reason})"
        for metric, scores in scores_of(choice):
            yield "", f"{metric}: " + ", ".join(f"{name} {score:.1f}" for name, score in scores.items())
    if repair := facts["distilled"]:
        yield "final scene", f"trained on {phrase_of(repair['chosen'])} of round {repair['round']}"
