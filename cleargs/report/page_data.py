"""Figures of the page: rows of frames, curves of trainings, and settings that differ from the defaults."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from cleargs.pipeline.config import Config
from cleargs.report.advice import toml_text
from cleargs.report.frames import FrameRow, faults_of, scores_of, worst_cue
from cleargs.report.pictures import FramePictures
from cleargs.rivr.candidates import phrase_of
from cleargs.scene.folder import SceneFolder
from cleargs.splat.tables import TRAIN


def changed_settings(config: Config) -> list[tuple[str, str, str, str]]:
    """Return name, value, default and meaning of each setting that differs from its default."""
    return [
        (setting.name, toml_text(value), toml_text(setting.default), setting.meaning)
        for setting, value in config.settings()
        if value != setting.default
    ]


def frame_data(row: FrameRow, pictures: FramePictures, time: float | None) -> dict[str, Any]:
    """Return the data of a frame for the page; ``time`` is its time in the viewer's animation, in seconds."""
    repair, why, scores = "none tried", "", {}
    if row.selection:
        choice = phrase_of(row.selection.chosen)
        refused = row.selection.chosen != "observed" and not row.chosen
        repair = f"kept as filmed, since {choice} was refused" if refused else choice
        scores = dict(scores_of(row.selection))
        why = row.selection.reason
    found = {
        "blur, px": row.motion("blur_px"),
        "rolling shutter, px": row.motion("skew_px"),
        "defocus, px": row.formation.get("defocus_px"),
        "exposure, stops": row.gain_ev,
        "camera speed, px per video frame": row.speed_px,
    }
    return {
        "id": row.frame.frame_id,
        "name": row.frame.name,
        "role": row.role,
        "weight": row.weight,
        "weight_text": row.weight_text,
        "psnr": row.psnr if pictures.psnr is None else pictures.psnr,
        "figures": {name: row.rated[name] for name in "RBGCDOZ" if row.rated.get(name) is not None},
        "worst": worst_cue(row.rated),
        "cues": dict(sorted(faults_of(row.rated).items(), key=lambda item: -item[1])),  # the worst first
        "repair": repair,
        "why": why,
        "chosen": row.chosen,
        "scores": scores,
        "found": {name: value for name, value in found.items() if value is not None},
        "formation": row.formation,
        "layers": {name: picture.path for name, picture in pictures.layers.items()},
        "time": time,
    }


_POINTS = 120  # maximum number per curve


def training_curves(run: Path, stages: Sequence[str]) -> dict[str, Any] | None:
    """Return loss, PSNR and number of Gaussians over the training steps; None before the first step.

    Loss and PSNR are those of steps on frame images. They are medians over equal intervals: each step shows
    one view, and views differ more than steps. Raises StoreError if a table cannot be read.
    """
    logs = {stage: SceneFolder(run / stage).log() for stage in stages}
    tables = {stage: log for stage, log in logs.items() if log is not None and log.num_rows}
    steps = pa.concat_tables([TRAIN.empty_table(), *tables.values()])
    real = np.array(steps["kind"].to_pylist()) == "real"
    if not real.any():
        return None
    curves: list[dict[str, Any]] = []
    for title, unit, name, digits in (
        ("PSNR on training frames", "dB", "psnr", 1),
        ("Loss", "", "loss", 3),
        ("Gaussians", "", "n_gaussians", 0),
    ):
        values = steps[name].to_numpy().astype(np.float64)
        known = np.flatnonzero(real & np.isfinite(values))
        intervals = np.array_split(known, min(_POINTS, max(1, len(known) // 6)))
        points = [(float(part.mean()), float(np.median(values[part]))) for part in intervals]
        curves.append({"title": title, "unit": unit, "digits": digits, "points": points})
    starts = np.cumsum([0, *(table.num_rows for table in tables.values())]).tolist()
    return {"steps": len(real), "parts": list(zip(tables, starts, strict=False)), "curves": curves}
