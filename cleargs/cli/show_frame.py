"""Frames in words: the rows of ``cleargs show RUN rva``, and ``cleargs show RUN --frame N``."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from cleargs.errors import InputError
from cleargs.manifest import Manifest
from cleargs.media.contact_sheet import Tile, contact_sheet
from cleargs.media.image import write_rgb
from cleargs.parquet import read_table
from cleargs.report.frames import (
    CHOICES,
    LAYERS,
    MEANINGS,
    FrameRow,
    camera_of,
    last_scene,
    layers_of,
    load_rows,
    scores_of,
)
from cleargs.rivr.gates import REFUSED
from cleargs.rivr.tables import REPAIRS
from cleargs.splat.ply import read_ply
from cleargs.splat.render import Viewer

MAX_NAME_LENGTH = 14
"""Characters of a frame's name in a table."""

MIN_FAULT = 0.2
"""Distance of a cue from its best value below which it is not reported."""

MODELS = {
    "none": "nothing found",
    "blur": "motion blur",
    "skew": "rolling shutter",
    "both": "motion blur and rolling shutter",
    "defocus": "defocus",
}
"""Model of a frame's formation -> its name."""

SOURCES = {
    "observation": "the frame as filmed",
    "deblurred": "the frame without its motion",
    "render": "the render",
}
"""Input of the expert -> its name."""

SCORES = {
    "R": "reliable appearance",
    "B": "risk of degradation",
    "G": "worth of its place",
    "C": "coverage gained",
    "D": "new directions",
    "O": "seen already",
    "Z": "middle of its stretch",
}
"""Score of RVA -> its meaning."""

_ACROSS = 3  # layers next to each other
_WIDEST = 640  # px, of a layer in the picture


def frame_rows(
    rows: Sequence[Mapping[str, Any]],
    settings: Mapping[str, Any],
    repairs: Sequence[Mapping[str, Any]] | None,
) -> list[dict[str, Any]]:
    """Return role, scores, worst cue, reason and repair of every frame.

    rows: those of rva/frames.parquet; settings: the configuration that they were made with; repairs: the rows
    of rivr/selection.parquet, None before RIVR (then there is no "repair").
    """
    latest = {row["frame_id"]: row for row in sorted(repairs or (), key=lambda row: int(row["round"]))}
    found = []
    for row in rows:
        line = {"frame": row["frame_id"], **{key: row[key] for key in ("name", "role", "weight", "R", "B")}}
        line |= {"worst cue": worst_cue(row), "reason": reason(row, settings)}
        if repairs is not None:
            line["repair"] = _repair(latest.get(row["frame_id"]))
        found.append(line)
    return found


def short_name(name: str) -> str:
    """The end of a frame's name, which tells it from the others."""
    last = name.rpartition("/")[2]
    return last if len(last) <= MAX_NAME_LENGTH else f"…{last[1 - MAX_NAME_LENGTH :]}"


def worst_cue(row: Mapping[str, Any]) -> str:
    """The cue farthest from its best value, and its value: "motion blur 0.82"; "" without a fault."""
    off = {name: 1.0 - value for name, value in row.items() if name.startswith("r_") and value is not None}
    off |= {name: value for name, value in row.items() if name.startswith("b_") and value is not None}
    worst = max(off, key=lambda name: off[name], default="")
    if not worst or off[worst] < MIN_FAULT:
        return ""
    return f"{worst[2:].replace('_', ' ')} {row[worst]:.2f}"


def reason(row: Mapping[str, Any], settings: Mapping[str, Any]) -> str:
    """The threshold that a frame passed or missed, which gave it its role."""
    if row["R"] is None:
        return "not scored"
    if row["G"] is None:
        return "no pose found"
    if not settings["enabled"]:
        return "all frames count"
    role = row["role"]
    if role == "strong":
        return "reliable"
    if settings["weighting"] == "binary":
        return "among the best" if role == "auxiliary" else "not among the best"
    low = _missed(row, settings["auxiliary_R"], settings["auxiliary_B"])
    missed = low or _missed(row, settings["tau_R"], settings["tau_B"])
    if role == "geometric":
        return f"{missed}, adds views"
    if role == "auxiliary":
        return f"{missed}, usable"
    if row["reactivated_for"] == "coverage":
        return f"{missed}, fills a gap"
    return missed if low else f"{missed}, no new view"


def _missed(row: Mapping[str, Any], min_R: float, max_B: float) -> str:
    """The threshold of the two that the frame misses; "" for none."""
    if row["R"] < min_R:
        return f"R < {min_R:.4g}"
    return f"B > {max_B:.4g}" if row["B"] > max_B else ""


def _repair(row: Mapping[str, Any] | None) -> str:
    """RIVR's choice in a frame's last round: the layer that supervises, refused, or none."""
    if row is None:
        return "none"
    if row["chosen"] == "observed":
        return "as filmed"
    refused = not row["accepted"] or row["reason"].startswith(REFUSED)
    return "refused" if refused else str(row["chosen"])


# -- one frame -----------------------------------------------------------------------------------------------


def show_frame(
    run: Path, done: Mapping[str, Manifest], frame_id: int, picture: Path
) -> tuple[dict[str, Any], list[tuple[str, str]]]:
    """Write the picture of a frame's layers; returns all facts for programs, and lines for readers.

    Raises InputError, StoreError.
    """
    if "ingest" not in done:
        raise InputError(f"{run} has no frames yet", hint=f"see cleargs status {run}")
    rows = {row.frame.frame_id: row for row in load_rows(run, done)}
    if frame_id not in rows:
        raise InputError(f"{run} has no frame {frame_id}", hint=f"choose one from {min(rows)} to {max(rows)}")
    row = rows[frame_id]
    facts = _frame_facts(run, row, done)
    lines = list(_lines(row, facts, run))
    return {**facts, "layers": _write_layers(picture, run, done, row), "picture": str(picture)}, lines


def _frame_facts(run: Path, row: FrameRow, done: Mapping[str, Manifest]) -> dict[str, Any]:
    """All facts of a frame, as ``--json`` prints them."""
    frame, judged, repairs = row.frame, dict(row.judged), []
    if judged:
        judged |= {"reason": reason(judged, done["rva"].parts.config), "worst_cue": worst_cue(judged)}
    if "consolidate" in done:
        repairs = read_table(run / "consolidate/repairs.parquet", REPAIRS).to_pylist()
    formation = row.formation.items()
    return {
        **asdict(frame),
        "centre": camera_of(frame).centre.tolist() if frame.registered else None,
        "rva": judged or None,
        "exposure_stops": row.gain_ev,
        "formation": {name: {"value": value, "meaning": MEANINGS.get(name, "")} for name, value in formation},
        "rounds": [asdict(found) for found in row.rounds],
        "distilled": next((line for line in repairs if line["frame_id"] == frame.frame_id), None),
    }


def _write_layers(path: Path, run: Path, stages: Collection[str], row: FrameRow) -> list[str]:
    """Write the layers of a frame side by side, labelled, as a PNG; returns their names.

    They are the frame as filmed, those of the latest round's EXR, and the last scene at the frame.
    """
    images = layers_of(row, run)
    scene = last_scene(stages)
    if scene is not None and row.frame.registered:
        images["final"] = Viewer(read_ply(run / scene / "scene.ply")).view(camera_of(row.frame), row.affine)
    shown = [name for name in LAYERS if name in images]
    tiles = []
    for name in shown:
        chosen = name == row.chosen
        label = f"{LAYERS[name]} (chosen)" if chosen else LAYERS[name]
        tiles.append(Tile(images[name], label, marked=chosen))
    path.parent.mkdir(parents=True, exist_ok=True)
    lines = [tiles[start : start + _ACROSS] for start in range(0, len(tiles), _ACROSS)]
    write_rgb(path, contact_sheet(lines, tile_width=min(_WIDEST, max(240, row.frame.width))))
    return shown


def _lines(row: FrameRow, facts: Mapping[str, Any], run: Path) -> Iterator[tuple[str, str]]:
    """Label and text of every line for a reader."""
    frame, judged = row.frame, facts["rva"]
    yield "file", frame.name
    yield "image", f"{run / 'ingest' / frame.image}, {frame.width}x{frame.height} px"
    if frame.time_s is not None:
        yield "time", f"{frame.time_s:.2f} s"
    if frame.split == "test":
        yield "held out", "for testing: it enters no training"
    if not frame.registered:
        yield "pose", f"none found: {frame.placed}" if frame.placed else "none found"
    else:
        centre = ", ".join(f"{value:.3f}" for value in facts["centre"])
        quaternion = ", ".join(f"{facts[name]:.3f}" for name in ("qw", "qx", "qy", "qz"))
        yield "pose", f"at ({centre}) of the run's world, world to camera ({quaternion}), w first"
        if frame.placed:
            yield "placed by", frame.placed
        yield "points", f"{frame.n_points} sparse points seen"
    if judged:
        yield "role", f"{judged['role']}, weight {row.weight:.2f}: {judged['reason']}"
        known = {name: value for name, value in judged.items() if value is not None}
        named = (f"{name} {known[name]:.2f} {text}" for name, text in SCORES.items() if name in known)
        yield "scores", ", ".join(named)
        for label, prefix in (("good, of 1", "r_"), ("bad, of 1", "b_")):
            cues = (name for name in known if name.startswith(prefix))
            yield label, ", ".join(f"{name[2:].replace('_', ' ')} {known[name]:.2f}" for name in cues)
        yield "worst cue", judged["worst_cue"] or "none"
    if row.gain_ev is not None:
        yield "exposure", f"{row.gain_ev:+.2f} stops compared with the scene's"
    if row.formation:
        yield from _formation(row.formation)
    for found in row.rounds:
        refused = ", refused" if not found.accepted and found.chosen != "observed" else ""
        yield f"round {found.round}", f"{CHOICES[found.chosen]}{refused} ({found.reason})"
        for metric, scores in scores_of(found):
            yield "", f"{metric}: " + ", ".join(f"{name} {score:.1f}" for name, score in scores.items())
        moved = found.blur_px is not None
        motion = f": blur {found.blur_px:.1f} px, skew {found.skew_px:.1f} px" if moved else ""
        yield "", f"restored from {SOURCES[found.restored_from]}{motion}"
    if repair := facts["distilled"]:
        yield "final scene", f"trained on {CHOICES[repair['chosen']]} of round {repair['round']}"


def _formation(row: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    found = MODELS.get(row["model"], row["model"])
    if row["model"] == "none":
        yield "formation", found
    else:
        yield "formation", f"{found}, which takes away {100 * row['explained']:.0f} % of the frame's misfit"
        lengths = (("blur", "blur_px"), ("rolling shutter", "skew_px"), ("defocus", "defocus_px"))
        yield "", ", ".join(f"{label} {row[name]:.2f} px" for label, name in lengths)
    yield "weight", f"{row['weight_before']:.2f} before, {row['weight_after']:.2f} after it"
