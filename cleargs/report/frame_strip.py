"""What became of every frame: the rows of a report's strip, joined from the tables of the stages."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from cleargs.capture.tables import Frame, load_frames
from cleargs.formation.exposure import Exposure, read_exposure
from cleargs.parquet import damage_told, read_table
from cleargs.rivr.tables import Selection, read_selection
from cleargs.rva.tables import B_CUES, FRAMES, R_CUES

HELD_OUT, UNPLACED = "held out", "not placed"
"""Roles of frames on which RVA has nothing to say."""

CHOICES = {
    "render": "the render",
    "restored": "the restored frame",
    "fused": "render and restored frame, fused",
    "observed": "none: the raw frame is kept",
}


@dataclass(frozen=True)
class FrameRow:
    """One frame; None where a stage has nothing to say about it."""

    frame: Frame
    role: str
    weight: float | None
    """Of its raw supervision, 0 to 1."""
    R: float | None
    B: float | None
    G: float | None
    cues: Mapping[str, float] = field(default_factory=dict)
    """Name -> how bad it is, 0 to 1, qualities turned round."""
    geometry: Mapping[str, float] = field(default_factory=dict)
    selection: Selection | None = None
    """Of the latest round."""
    gain_ev: float | None = None
    """Exposure beside the scene's at middle grey, stops; None without compensation."""
    formation: Mapping[str, Any] = field(default_factory=dict)
    """Column of ``formation.parquet`` -> value."""

    @property
    def worst(self) -> tuple[str, float] | None:
        """The worst cue and how bad it is."""
        return max(self.cues.items(), key=lambda item: item[1], default=None)

    @property
    def blur_px(self) -> float | None:
        """How far the pixels moved while exposed."""
        return self._motion("blur_px")

    @property
    def skew_px(self) -> float | None:
        """How far the last line of pixels moved against the first."""
        return self._motion("skew_px")

    def _motion(self, name: str) -> float | None:
        found: float | None = self.formation.get(name)
        return found if found is not None or self.selection is None else getattr(self.selection, name)

    @property
    def repair(self) -> str:
        """The repair chosen, in words."""
        if self.selection is None:
            return "none tried"
        chosen = CHOICES[self.selection.chosen]
        kept = self.selection.accepted or self.selection.chosen == "observed"
        return chosen if kept else f"none: {chosen} was refused"

    @property
    def why(self) -> str:
        """Why it was chosen."""
        if self.selection is None:
            return ""
        scores = scores_of(self.selection, "primary")
        found = ", ".join(f"{name} {score:.1f}" for name, score in scores.items())
        return f"{self.selection.reason}; {self.selection.primary_metric}: {found}"


def scores_of(selection: Selection, role: str) -> dict[str, float]:
    """Candidate -> score by the ``primary`` or ``tiebreak`` scorer."""
    scores = {name: getattr(selection, f"{role}_{name}") for name in CHOICES}
    return {name: score for name, score in scores.items() if score is not None}


SCENES = ("g0", "rivr", "consolidate")
"""The stages that make a scene, in order."""


def last_scene(stages: Collection[str]) -> str | None:
    """The last of ``stages`` that makes a scene; None without one."""
    return next((stage for stage in reversed(SCENES) if stage in stages), None)


def load_rows(run: Path, stages: Collection[str]) -> list[FrameRow]:
    """The frames of ``run`` in their order, as far as ``stages`` say something of them. Raises StoreError."""
    judged = _judged(run) if "rva" in stages else {}
    selections = _selections(run) if "rivr" in stages else {}
    final = last_scene(stages)
    exposure = read_exposure(run / final / "exposure.parquet") if final else None
    formation = _formation(run, final)
    rows = []
    for frame in load_frames(run / "ingest"):
        seen = judged.get(frame.frame_id, {})
        role = seen.get("role", "") if frame.split == "train" else HELD_OUT
        rows.append(
            FrameRow(
                frame=frame,
                role=role if frame.registered else UNPLACED,
                weight=seen.get("weight"),
                R=seen.get("R"),
                B=seen.get("B"),
                G=seen.get("G"),
                cues=_cues(seen),
                geometry={name: seen[name] for name in "CDOZ" if seen.get(name) is not None},
                selection=selections.get(frame.frame_id),
                gain_ev=_gain(exposure, frame.frame_id),
                formation=formation.get(frame.frame_id, {}),
            )
        )
    return rows


def _judged(run: Path) -> dict[int, dict[str, Any]]:
    path = run / "rva" / "frames.parquet"
    return {row["frame_id"]: row for row in read_table(path, FRAMES).to_pylist()} if path.is_file() else {}


def _selections(run: Path) -> dict[int, Selection]:
    """The row of the latest round of every target frame."""
    path = run / "rivr" / "selection.parquet"
    rows = read_selection(path) if path.is_file() else []
    return {row.frame_id: row for row in sorted(rows, key=lambda row: row.round)}


def _formation(run: Path, final: str | None) -> dict[int, dict[str, Any]]:
    """What the camera did to each frame, as the latest stage found it."""
    path = run / (final or "") / "formation.parquet"
    if not path.is_file():
        return {}
    with damage_told(path):
        rows = pq.read_table(path).to_pylist()
    return {row.pop("frame_id"): row for row in rows if "frame_id" in row}


def formation_meanings(run: Path, final: str | None) -> dict[str, str]:
    """Column of ``formation.parquet`` -> what it means."""
    path = run / (final or "") / "formation.parquet"
    with damage_told(path):
        schema = pq.read_schema(path) if path.is_file() else pa.schema([])
    return {field.name: (field.metadata or {}).get(b"meaning", b"").decode() for field in schema}


def _cues(row: Mapping[str, Any]) -> dict[str, float]:
    qualities = {f"low {name}": row.get(f"r_{name}") for name in R_CUES}
    lacking = {name: 1.0 - value for name, value in qualities.items() if value is not None}
    harms = {name.replace("_", " "): row.get(f"b_{name}") for name in B_CUES}
    return {**lacking, **{name: value for name, value in harms.items() if value is not None}}


def _gain(exposure: Exposure | None, frame_id: int) -> float | None:
    if exposure is None or not exposure.enabled or frame_id not in exposure.frame_ids:
        return None
    affine = exposure.of(frame_id)
    grey = affine[:, :3].sum(axis=1) * 0.5 + affine[:, 3]
    # sRGB to linear light near middle grey is a power of 2.4 or so; a stop is a factor of two there.
    return 2.4 * math.log2(max(float(grey.mean()), 1e-3) / 0.5)
