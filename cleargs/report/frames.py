"""The frames of a report: their data from the tables of the stages."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pyarrow as pa

from cleargs.capture.motion_table import MOTION
from cleargs.capture.tables import Frame, load_frames
from cleargs.formation.table import FORMATION
from cleargs.parquet import read_table
from cleargs.rivr.tables import Selection, read_selection
from cleargs.rva.tables import B_CUES, FRAMES, R_CUES
from cleargs.scene.folder import SceneFolder
from cleargs.scene.viewer import SceneViewer
from cleargs.types import ArrayF64, MaskBool

HELD_OUT, UNPLACED = "held out", "not placed"
"""Roles, on the page, of frames that RVA does not rate."""

EFFECTS = {
    "blur": ("motion blur", "blur_px"),
    "skew": ("rolling shutter", "skew_px"),
    "both": ("motion blur and rolling shutter", "blur_px"),
    "defocus": ("defocus", "defocus_px"),
}
"""Model of image formation -> its name, and the column of ``formation.parquet`` with its size."""

MIN_FAULT = 0.2
"""Smaller faults of a frame are not reported."""

LAST_STEPS = 3
"""Number of last training steps on a frame. The median of their PSNR is shown for the frame."""

MEANINGS = {column.name: column.metadata[b"meaning"].decode() for column in FORMATION}
"""Column of ``formation.parquet`` -> its meaning."""


@dataclass(frozen=True)
class FrameRow:
    """One frame, with the results of the stages for it."""

    frame: Frame
    rated: Mapping[str, Any] = field(default_factory=dict)
    """The row of the frame in ``rva/frames.parquet``; empty without one."""
    rounds: tuple[Selection, ...] = ()
    """The rows of the frame in ``rivr/selection.parquet``, in the order of the rounds."""
    affine: ArrayF64 | None = None  # [3, 4]
    """Transform of sRGB colours from the last scene to the frame; None without exposure compensation."""
    formation: Mapping[str, Any] = field(default_factory=dict)
    """Column of ``formation.parquet`` of the last scene -> value; empty without one."""
    psnr: float | None = None
    """Median PSNR, dB, of the last training steps on the frame image, as its camera saw it; None if no
    training used the frame."""
    moving: MaskBool | None = None  # [rows, columns]
    """True for the cells of an even grid that the training ignored, because something moves there."""
    speed_px: float | None = None
    """Measured speed of the scene in the image, px per frame of the video; None if none was measured."""

    @property
    def role(self) -> str:
        """Role by RVA, `HELD_OUT` or `UNPLACED`; "" if it is unknown."""
        if not self.frame.registered:
            return UNPLACED
        return HELD_OUT if self.frame.split != "train" else str(self.rated.get("role", ""))

    @property
    def weight(self) -> float | None:
        """Weight of the frame image at the end of the training, from 0 to 1; None if it is unknown."""
        weight: float | None = self.formation.get("weight_after", self.rated.get("weight"))
        return weight

    @property
    def weight_text(self) -> str:
        """The weight of the frame image in words, with its reason; "" if it is unknown."""
        if self.role in (UNPLACED, HELD_OUT):
            return f"{self.role}: not used"
        if self.weight is None:
            return ""
        counts = "counts fully" if self.weight > 0.995 else f"counts {100 * self.weight:.0f} %"
        counts = counts if self.weight else "not used"
        if self.modelled:
            effect, size = EFFECTS[self.formation["model"]]
            return f"{effect} {self.formation[size]:.1f} px, simulated: {counts}"
        fault = worst_cue(self.rated)
        return f"{fault}: {counts}" if fault and self.weight < 0.995 else counts

    @property
    def selection(self) -> Selection | None:
        """Row of the latest round."""
        return self.rounds[-1] if self.rounds else None

    @property
    def chosen(self) -> str | None:
        """Candidate of the latest round that repairs the frame; None if the frame is kept as filmed."""
        return self.selection.chosen if self.selection is not None and self.selection.accepted else None

    @property
    def modelled(self) -> bool:
        """True if the last scene has a model of the frame's image formation (blur, rolling shutter)."""
        return self.formation.get("model", "none") != "none" and self.frame.registered

    @property
    def gain_ev(self) -> float | None:
        """Exposure relative to the scene at middle grey, in stops; None without compensation."""
        if self.affine is None:
            return None
        grey = self.affine[:, :3].sum(axis=1) * 0.5 + self.affine[:, 3]
        # Near middle grey, linear light is about the sRGB value to the power of 2.4. A stop is a factor of 2.
        return 2.4 * math.log2(max(float(grey.mean()), 1e-3) / 0.5)

    def motion(self, name: Literal["blur_px", "skew_px"]) -> float | None:
        """Return the fitted motion blur, or the rolling shutter between first and last line, in pixels."""
        found: float | None = self.formation.get(name, getattr(self.selection, name, None))
        return found


def worst_cue(rated: Mapping[str, Any]) -> str:
    """Return the largest fault of a row of ``rva/frames.parquet``, from 0 (good) to 1, as "blur 0.82".

    A low quality counts as a fault too, as "low sharpness 0.94". "" if no fault reaches `MIN_FAULT`.
    """
    faults = faults_of(rated)
    name = max(faults, key=lambda name: faults[name], default="")
    return f"{name} {faults[name]:.2f}" if name and faults[name] >= MIN_FAULT else ""


def faults_of(rated: Mapping[str, Any]) -> dict[str, float]:
    """Return the cues of a row of ``rva/frames.parquet`` as faults, from 0 (good) to 1 (bad)."""
    lacking = {f"low {name}": rated.get(f"r_{name}") for name in R_CUES}
    harms = {name.replace("_", " "): rated.get(f"b_{name}") for name in B_CUES}
    faults = {name: 1.0 - value for name, value in lacking.items() if value is not None}
    return faults | {name: value for name, value in harms.items() if value is not None}


def scene_with_models(rows: Sequence[FrameRow], run: Path, stages: Collection[str]) -> SceneViewer | None:
    """Return the last scene of ``run`` if it has a model of image formation for any of ``rows``, else None.

    Raises StoreError if a file of the scene is damaged.
    """
    last = last_scene(stages)
    return SceneViewer(run / last) if last and any(row.modelled for row in rows) else None


def scores_of(selection: Selection) -> list[tuple[str, dict[str, float]]]:
    """Return the deciding scorer, then the scorer for ties, each as (name, candidate -> score)."""
    uses = ((selection.primary_metric, selection.primary), (selection.tiebreak_metric, selection.tiebreak))
    return [(metric, dict(scores)) for metric, scores in uses if metric is not None]


SCENES = ("g0", "rivr", "consolidate")
"""Stages that train a scene, in order."""


def last_scene(stages: Collection[str]) -> str | None:
    """Return the last of ``stages`` that trains a scene; None without one."""
    return next((stage for stage in reversed(SCENES) if stage in stages), None)


def load_rows(run: Path, stages: Collection[str]) -> list[FrameRow]:
    """Return the data of all frames of a run, in the order of the capture, after the finished ``stages``.

    Raises StoreError if a table cannot be read.
    """
    rated: dict[int, dict[str, Any]] = {}
    if "rva" in stages:
        rows = read_table(run / "rva" / "frames.parquet", FRAMES).to_pylist()
        rated = {row["frame_id"]: row for row in rows}
    rounds: dict[int, list[Selection]] = {}
    if "rivr" in stages:
        for found in sorted(read_selection(run / "rivr" / "selection.parquet"), key=lambda row: row.round):
            rounds.setdefault(found.frame_id, []).append(found)
    psnr = _last_psnr([SceneFolder(run / stage).log() for stage in SCENES if stage in stages])
    affines: dict[int, ArrayF64] = {}
    formation: dict[int, dict[str, Any]] = {}  # stays empty if image formation is off
    moving: dict[int, MaskBool] = {}
    if final := last_scene(stages):
        scene = SceneFolder(run / final)
        moving, formation, exposure = scene.moving(), scene.formation_rows(), scene.exposure()
        if exposure.enabled:
            affines = dict(zip(exposure.frame_ids.tolist(), exposure.affines, strict=True))
    speeds: dict[int, float] = {}
    if (path := run / "ingest" / "motion.parquet").is_file():
        for row in read_table(path, MOTION).to_pylist():
            if row["speed_px"] is not None:
                speeds[row["frame_id"]] = row["speed_px"] * row["frame_s"]
    return [
        FrameRow(
            frame,
            rated.get(frame.frame_id, {}),
            tuple(rounds.get(frame.frame_id, ())),
            affines.get(frame.frame_id),
            formation.get(frame.frame_id, {}),
            psnr.get(frame.frame_id),
            moving.get(frame.frame_id),
            speeds.get(frame.frame_id),
        )
        for frame in load_frames(run / "ingest")
    ]


def _last_psnr(logs: Sequence[pa.Table | None]) -> dict[int, float]:
    """Return frame_id -> median PSNR of the last `LAST_STEPS` steps on the frame image at its full size."""
    steps: dict[int, list[tuple[int, float]]] = {}
    for table in filter(None, logs):
        columns = (table[name].to_pylist() for name in ("frame_id", "kind", "width", "psnr"))
        for frame_id, kind, width, psnr in zip(*columns, strict=True):
            if kind == "real" and math.isfinite(psnr):
                steps.setdefault(frame_id, []).append((width, psnr))
    found = {}
    for frame_id, of_frame in steps.items():
        full = max(width for width, _ in of_frame)
        found[frame_id] = float(np.median([psnr for width, psnr in of_frame if width == full][-LAST_STEPS:]))
    return found
