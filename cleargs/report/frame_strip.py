"""What became of every frame: the rows of a report's strip, joined from the tables of the stages."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from cleargs.capture.tables import Frame, load_frames
from cleargs.formation.exposure import read_exposure
from cleargs.formation.table import FORMATION
from cleargs.parquet import read_any_table, read_table
from cleargs.rivr.tables import Selection, read_selection
from cleargs.rva.tables import FRAMES

HELD_OUT, UNPLACED = "held out", "not placed"
"""Roles of frames on which RVA has nothing to say."""

CHOICES = {
    "render": "the render",
    "restored": "the restored frame",
    "fused": "render and restored frame, fused",
    "observed": "none: the raw frame is kept",
}

MEANINGS = {column.name: column.metadata[b"meaning"].decode() for column in FORMATION}
"""Column of ``formation.parquet`` -> what it means."""


@dataclass(frozen=True)
class FrameRow:
    """One frame, and what the stages say of it."""

    frame: Frame
    judged: Mapping[str, Any] = field(default_factory=dict)
    """Its row of ``rva/frames.parquet``; empty without one."""
    rounds: tuple[Selection, ...] = ()
    """Its rows of ``rivr/selection.parquet``, in the order of the rounds."""
    affine: NDArray[np.float64] | None = None  # [3, 4]
    """The colours of the last scene to those of the frame; None without compensation."""
    formation: Mapping[str, Any] = field(default_factory=dict)
    """Column of the last scene's ``formation.parquet`` -> value; empty without one."""

    @property
    def role(self) -> str:
        """RVA's, or one of the two above; "" where it is unknown."""
        if not self.frame.registered:
            return UNPLACED
        return HELD_OUT if self.frame.split != "train" else str(self.judged.get("role", ""))

    @property
    def weight(self) -> float | None:
        """Weight of its raw supervision, 0 to 1."""
        return self.judged.get("weight")

    @property
    def selection(self) -> Selection | None:
        """Its row of the latest round."""
        return self.rounds[-1] if self.rounds else None

    @property
    def chosen(self) -> str | None:
        """The layer of the latest round that supervises the frame."""
        if self.selection is None:
            return None
        kept = self.selection.accepted or self.selection.chosen == "observed"
        return self.selection.chosen if kept else None

    @property
    def gain_ev(self) -> float | None:
        """Exposure next to the scene's at middle grey, stops; None without compensation."""
        if self.affine is None:
            return None
        grey = self.affine[:, :3].sum(axis=1) * 0.5 + self.affine[:, 3]
        # sRGB to linear light near middle grey is a power of 2.4 or so; a stop is a factor of two there.
        return 2.4 * math.log2(max(float(grey.mean()), 1e-3) / 0.5)

    def motion(self, name: Literal["blur_px", "skew_px"]) -> float | None:
        """The way of the pixels while exposed, or of the last line of pixels against the first."""
        found: float | None = self.formation.get(name, getattr(self.selection, name, None))
        return found


def scores_of(selection: Selection) -> list[tuple[str, dict[str, float]]]:
    """Name of the scorer, and candidate -> score: of the one that decides, then of that for ties."""
    found = []
    for use in ("primary", "tiebreak"):
        scores = {name: getattr(selection, f"{use}_{name}") for name in CHOICES}
        known = {name: score for name, score in scores.items() if score is not None}
        found.append((getattr(selection, f"{use}_metric"), known))
    return found


SCENES = ("g0", "rivr", "consolidate")
"""The stages that make a scene, in order."""


def last_scene(stages: Collection[str]) -> str | None:
    """The last of ``stages`` that makes a scene; None without one."""
    return next((stage for stage in reversed(SCENES) if stage in stages), None)


def load_rows(run: Path, stages: Collection[str]) -> list[FrameRow]:
    """The frames of ``run`` in their order, as far as ``stages`` say something of them. Raises StoreError."""
    judged: dict[int, dict[str, Any]] = {}
    if "rva" in stages:
        rows = read_table(run / "rva" / "frames.parquet", FRAMES).to_pylist()
        judged = {row["frame_id"]: row for row in rows}
    rounds: dict[int, list[Selection]] = {}
    if "rivr" in stages:
        for found in sorted(read_selection(run / "rivr" / "selection.parquet"), key=lambda row: row.round):
            rounds.setdefault(found.frame_id, []).append(found)
    affines: dict[int, NDArray[np.float64]] = {}
    formation: dict[int, dict[str, Any]] = {}  # a scene may be trained without asking what the camera did
    if final := last_scene(stages):
        exposure = read_exposure(run / final / "exposure.parquet")
        if exposure.enabled:
            affines = dict(zip(exposure.frame_ids.tolist(), exposure.affines, strict=True))
        if (path := run / final / "formation.parquet").is_file():
            formation = {row.pop("frame_id"): row for row in read_any_table(path).to_pylist()}
    return [
        FrameRow(
            frame,
            judged.get(frame.frame_id, {}),
            tuple(rounds.get(frame.frame_id, ())),
            affines.get(frame.frame_id),
            formation.get(frame.frame_id, {}),
        )
        for frame in load_frames(run / "ingest")
    ]
