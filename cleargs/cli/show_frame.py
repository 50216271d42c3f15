"""Frames in words: the rows of ``cleargs show RUN rva``, and ``cleargs show RUN --frame N``."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from cleargs.cli.common import print_json
from cleargs.cli.tables import line_table, print_table, text_of
from cleargs.errors import InputError
from cleargs.manifest import Manifest

if TYPE_CHECKING:
    from cleargs.report.frame_strip import FrameRow

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
        return f"R < {text_of(min_R)}"
    return f"B > {text_of(max_B)}" if row["B"] > max_B else ""


def _repair(row: Mapping[str, Any] | None) -> str:
    """RIVR's choice in a frame's last round: the layer that supervises, refused, or none."""
    from cleargs.rivr.gates import REFUSED

    if row is None:
        return "none"
    if row["chosen"] == "observed":
        return "as filmed"
    refused = not row["accepted"] or row["reason"].startswith(REFUSED)
    return "refused" if refused else str(row["chosen"])


# -- one frame -----------------------------------------------------------------------------------------------


def show_frame(run: Path, done: Mapping[str, Manifest], frame_id: int, picture: Path, as_json: bool) -> None:
    """Print everything about a frame, and write the picture of its layers. Raises InputError, StoreError."""
    from cleargs.report.frame_strip import load_rows

    if "ingest" not in done:
        raise InputError(f"{run} has no frames yet", hint=f"see cleargs status {run}")
    rows = {row.frame.frame_id: row for row in load_rows(run, done)}
    if frame_id not in rows:
        raise InputError(f"{run} has no frame {frame_id}", hint=f"choose one from {min(rows)} to {max(rows)}")
    facts = _frame_facts(run, rows[frame_id], done)
    layers = _write_layers(picture, run, done, rows[frame_id])
    if as_json:
        print_json({**facts, "layers": layers, "picture": str(picture)})
    else:
        print_table(line_table(f"frame {frame_id}", _lines(facts, run)))
        click.echo(f"written: {picture}")


def _frame_facts(run: Path, row: FrameRow, done: Mapping[str, Manifest]) -> dict[str, Any]:
    """All facts of a frame, as ``--json`` prints them."""
    from cleargs.parquet import read_table
    from cleargs.report.frame_strip import formation_meanings, last_scene
    from cleargs.report.web_scene import camera_of
    from cleargs.rivr.tables import REPAIRS, read_selection
    from cleargs.rva.tables import FRAMES

    frame = row.frame

    def own(path: str, schema: Any) -> dict[str, Any] | None:
        found: list[dict[str, Any]] = read_table(run / path, schema).to_pylist()
        return next((line for line in found if line["frame_id"] == frame.frame_id), None)

    judged = own("rva/frames.parquet", FRAMES) if "rva" in done else None
    if judged is not None:
        config = done["rva"].parts.config
        judged |= {"reason": reason(judged, config), "worst_cue": worst_cue(judged)}
    meanings = formation_meanings(run, last_scene(done))
    rounds = read_selection(run / "rivr/selection.parquet") if "rivr" in done else []
    return {
        **asdict(frame),
        "centre": camera_of(frame).centre.tolist() if frame.registered else None,
        "rva": judged,
        "exposure_stops": row.gain_ev,
        "formation": {
            name: {"value": value, "meaning": meanings.get(name, "")} for name, value in row.formation.items()
        },
        "rounds": [asdict(found) for found in rounds if found.frame_id == frame.frame_id],
        "distilled": own("consolidate/repairs.parquet", REPAIRS) if "consolidate" in done else None,
    }


def _write_layers(path: Path, run: Path, stages: Collection[str], row: FrameRow) -> list[str]:
    """Write the layers of a frame side by side, labelled, as a PNG; returns their names.

    They are the frame as filmed, those of the latest round's EXR, and the last scene at the frame.
    """
    import numpy as np

    from cleargs.formation.exposure import read_exposure
    from cleargs.media.contact_sheet import Tile, contact_sheet
    from cleargs.media.image import write_rgb
    from cleargs.report.frame_pictures import LAYERS, layers_of
    from cleargs.report.frame_strip import last_scene
    from cleargs.report.web_scene import Renderer, camera_of
    from cleargs.splat.ply import read_ply

    images = layers_of(row, run)
    scene = last_scene(stages)
    if scene is not None and row.frame.registered:
        affine = read_exposure(run / scene / "exposure.parquet").of(row.frame.frame_id)
        images["final"] = Renderer(read_ply(run / scene / "scene.ply"))(camera_of(row.frame), affine)
    selection = row.selection
    kept = selection is not None and (selection.accepted or selection.chosen == "observed")
    chosen = selection.chosen if selection is not None and kept else None
    shown = [name for name in LAYERS if name in images]
    tiles = [
        Tile(
            images[name].astype(np.float32) / np.float32(255),
            f"{LAYERS[name]}{' (chosen)' if name == chosen else ''}",
            marked=name == chosen,
        )
        for name in shown
    ]
    rows = [tiles[start : start + _ACROSS] for start in range(0, len(tiles), _ACROSS)]
    path.parent.mkdir(parents=True, exist_ok=True)
    write_rgb(path, contact_sheet(rows, tile_width=min(_WIDEST, max(240, row.frame.width))))
    return shown


def _lines(facts: Mapping[str, Any], run: Path) -> Iterator[tuple[str, str]]:
    """Label and text of every line for a reader."""
    from cleargs.report.frame_strip import CHOICES

    yield "file", facts["name"]
    yield "image", f"{run / 'ingest' / facts['image']}, {facts['width']}x{facts['height']} px"
    if facts["time_s"] is not None:
        yield "time", f"{facts['time_s']:.2f} s"
    if facts["split"] == "test":
        yield "held out", "for testing: it enters no training"
    if facts["centre"] is None:
        yield "pose", f"none found: {facts['placed']}" if facts["placed"] else "none found"
    else:
        centre = ", ".join(f"{value:.3f}" for value in facts["centre"])
        quaternion = ", ".join(f"{facts[name]:.3f}" for name in ("qw", "qx", "qy", "qz"))
        yield "pose", f"at ({centre}) of the run's world, world to camera ({quaternion}), w first"
        if facts["placed"]:
            yield "placed by", facts["placed"]
        yield "points", f"{facts['n_points']} sparse points seen"
    if row := facts["rva"]:
        yield "role", f"{row['role']}, weight {row['weight']:.2f}: {row['reason']}"
        known = [f"{name} {row[name]:.2f} {text}" for name, text in SCORES.items() if row[name] is not None]
        yield "scores", ", ".join(known)
        for label, prefix in (("good, of 1", "r_"), ("bad, of 1", "b_")):
            cues = {key[2:].replace("_", " "): row[key] for key in row if key.startswith(prefix)}
            yield label, ", ".join(f"{name} {value:.2f}" for name, value in cues.items() if value is not None)
        yield "worst cue", row["worst_cue"] or "none"
    if facts["exposure_stops"] is not None:
        yield "exposure", f"{facts['exposure_stops']:+.2f} stops compared with the scene's"
    if facts["formation"]:
        yield from _formation({name: found["value"] for name, found in facts["formation"].items()})
    for found in facts["rounds"]:
        refused = ", refused" if not found["accepted"] and found["chosen"] != "observed" else ""
        yield f"round {found['round']}", f"{CHOICES[found['chosen']]}{refused} ({found['reason']})"
        for use in ("primary", "tiebreak"):
            scores = {name: found[f"{use}_{name}"] for name in CHOICES}
            known = [f"{name} {score:.1f}" for name, score in scores.items() if score is not None]
            yield "", f"{found[f'{use}_metric']}: {', '.join(known)}"
        moved = found["blur_px"] is not None
        motion = f": blur {found['blur_px']:.1f} px, skew {found['skew_px']:.1f} px" if moved else ""
        yield "", f"restored from {SOURCES[found['restored_from']]}{motion}"
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
