"""Everything about one frame: ``cleargs show RUN --frame N``."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from cleargs.cli.frame_reasons import reason, worst_cue
from cleargs.errors import InputError
from cleargs.formation.exposure import read_exposure
from cleargs.media.image import write_rgb
from cleargs.parquet import read_table
from cleargs.report.contact import Tile, contact_sheet
from cleargs.report.frame_pictures import LAYERS, layers_of
from cleargs.report.frame_strip import CHOICES, FrameRow, formation_meanings, last_scene, load_rows
from cleargs.report.web_scene import Renderer, camera_of
from cleargs.rivr.tables import REPAIRS, read_selection
from cleargs.rva.tables import B_CUES, FRAMES, R_CUES
from cleargs.splat.ply import read_ply

MODELS = {
    "none": "nothing found",
    "blur": "motion blur",
    "skew": "rolling shutter",
    "both": "motion blur and rolling shutter",
    "defocus": "defocus",
}
"""Model of a frame's formation -> what it is called."""

SOURCES = {
    "observation": "the frame as filmed",
    "deblurred": "the frame without its motion",
    "render": "the render",
}
"""What the expert restored -> what it is called."""

_ACROSS = 3  # layers beside each other
_WIDEST = 640  # px, of a layer in the picture


def frame_row(run: Path, stages: Collection[str], frame_id: int) -> FrameRow:
    """What the finished ``stages`` of ``run`` say of a frame. Raises InputError for no such frame."""
    rows = {row.frame.frame_id: row for row in load_rows(run, stages)}
    if frame_id not in rows:
        raise InputError(f"{run} has no frame {frame_id}", hint=f"choose one from {min(rows)} to {max(rows)}")
    return rows[frame_id]


def frame_facts(
    run: Path, stages: Collection[str], row: FrameRow, settings: Mapping[str, Any]
) -> dict[str, Any]:
    """All facts of a frame, as ``--json`` prints them; ``settings``: those that RVA was made with."""
    frame = row.frame
    judged = _row(run / "rva/frames.parquet", FRAMES, frame.frame_id) if "rva" in stages else None
    meanings = formation_meanings(run, last_scene(stages))
    rounds = read_selection(run / "rivr/selection.parquet") if "rivr" in stages else []
    return {
        **asdict(frame),
        "centre": camera_of(frame).centre.tolist() if frame.registered else None,
        "rva": judged and {**judged, "reason": reason(judged, settings), "worst_cue": worst_cue(judged)},
        "exposure_stops": row.gain_ev,
        "formation": {
            name: {"value": value, "meaning": meanings.get(name, "")} for name, value in row.formation.items()
        },
        "rounds": [asdict(found) for found in rounds if found.frame_id == frame.frame_id],
        "distilled": _row(run / "consolidate/repairs.parquet", REPAIRS, frame.frame_id)
        if "consolidate" in stages
        else None,
    }


def _row(path: Path, schema: Any, frame_id: int) -> dict[str, Any] | None:
    rows: Sequence[dict[str, Any]] = read_table(path, schema).to_pylist()
    return next((row for row in rows if row["frame_id"] == frame_id), None)


def write_layers(path: Path, run: Path, stages: Collection[str], row: FrameRow) -> list[str]:
    """Write the layers of a frame side by side, labelled, as a PNG; returns their names.

    They are the frame as filmed, those of the latest round's EXR, and the last scene at the frame.
    """
    images = layers_of(row, run)
    scene = last_scene(stages)
    if scene is not None and row.frame.registered:
        affine = read_exposure(run / scene / "exposure.parquet").of(row.frame.frame_id)
        images["final"] = Renderer(read_ply(run / scene / "scene.ply"))(camera_of(row.frame), affine)
    selection = row.selection
    kept = selection is not None and (selection.accepted or selection.chosen == "observed")
    chosen = selection.chosen if selection is not None and kept else None
    tiles = [
        Tile(
            images[name].astype(np.float32) / np.float32(255),
            f"{LAYERS[name]}{' (chosen)' if name == chosen else ''}",
            marked=name == chosen,
        )
        for name in LAYERS
        if name in images
    ]
    rows = [tiles[start : start + _ACROSS] for start in range(0, len(tiles), _ACROSS)]
    path.parent.mkdir(parents=True, exist_ok=True)
    write_rgb(path, contact_sheet(rows, tile_width=min(_WIDEST, max(240, row.frame.width))))
    return [name for name in LAYERS if name in images]


def in_lines(facts: Mapping[str, Any], run: Path) -> Iterator[tuple[str, str]]:
    """Label and text of every line for a reader."""
    yield "file", facts["name"]
    yield "image", f"{run / 'ingest' / facts['image']}, {facts['width']}x{facts['height']} px"
    if facts["time_s"] is not None:
        yield "time", f"{facts['time_s']:.2f} s"
    if facts["split"] == "test":
        yield "held out", "for testing: it enters no training"
    if facts["centre"] is None:
        yield "pose", f"none found: {facts['placed']}" if facts["placed"] else "none found"
    else:
        x, y, z = facts["centre"]
        quaternion = ", ".join(f"{facts[name]:.3f}" for name in ("qw", "qx", "qy", "qz"))
        place = f"at ({x:.3f}, {y:.3f}, {z:.3f}) of the run's world"
        yield "pose", f"{place}, world to camera ({quaternion}), w first"
        if facts["placed"]:
            yield "placed by", facts["placed"]
        yield "points", f"{facts['n_points']} sparse points seen"
    if facts["rva"] is not None:
        yield from _judged(facts["rva"])
    if facts["exposure_stops"] is not None:
        yield "exposure", f"{facts['exposure_stops']:+.2f} stops beside the scene's"
    if facts["formation"]:
        yield from _formation({name: found["value"] for name, found in facts["formation"].items()})
    for found in facts["rounds"]:
        yield from _round(found)
    if facts["distilled"] is not None:
        repair = facts["distilled"]
        yield "final scene", f"trained on {CHOICES[repair['chosen']]} of round {repair['round']}"


def _judged(row: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    yield "role", f"{row['role']}, weight {row['weight']:.2f}: {row['reason']}"
    names = {
        "R": "reliable appearance",
        "B": "risk of degradation",
        "G": "worth of its place",
        "C": "coverage gained",
        "D": "new directions",
        "O": "seen already",
        "Z": "middle of its stretch",
    }
    known = [f"{name} {row[name]:.2f} {meaning}" for name, meaning in names.items() if row[name] is not None]
    yield "scores", ", ".join(known)
    for label, prefix, cues in (("good, of 1", "r", R_CUES), ("bad, of 1", "b", B_CUES)):
        values = {name.replace("_", " "): row[f"{prefix}_{name}"] for name in cues}
        yield label, ", ".join(f"{name} {value:.2f}" for name, value in values.items() if value is not None)
    yield "worst cue", row["worst_cue"] or "none"


def _formation(row: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    found = MODELS.get(row["model"], row["model"])
    if row["model"] != "none":
        found += f", which takes away {100 * row['explained']:.0f} % of the frame's misfit"
    yield "formation", found
    if row["model"] != "none":
        lengths = (("blur", "blur_px"), ("rolling shutter", "skew_px"), ("defocus", "defocus_px"))
        yield "", ", ".join(f"{label} {row[name]:.2f} px" for label, name in lengths)
    yield "weight", f"{row['weight_before']:.2f} before, {row['weight_after']:.2f} after it"


def _round(row: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    refused = not row["accepted"] and row["chosen"] != "observed"
    yield (
        f"round {row['round']}",
        f"{CHOICES[row['chosen']]}{', refused' if refused else ''} ({row['reason']})",
    )
    for use in ("primary", "tiebreak"):
        scores = {name: row[f"{use}_{name}"] for name in CHOICES}
        known = ", ".join(f"{name} {score:.1f}" for name, score in scores.items() if score is not None)
        yield "", f"{row[f'{use}_metric']}: {known}"
    source = f"restored from {SOURCES[row['restored_from']]}"
    if row["blur_px"] is not None:
        source += f": blur {row['blur_px']:.1f} px, skew {row['skew_px']:.1f} px"
    yield "", source
