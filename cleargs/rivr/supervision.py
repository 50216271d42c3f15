"""The frames of a capture as RIVR and the consolidation see them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import pyarrow as pa

from cleargs.capture.tables import load_frames
from cleargs.errors import StageError
from cleargs.parquet import read_table
from cleargs.rivr.targets import Appraisal, Targets, held_back_frames, target_frames
from cleargs.rva.tables import FRAMES
from cleargs.splat.views import View, view_of

_COLUMNS = ("frame_id", "R", "B", "role", "reliable", "stand_in", "weight")
_APPRAISED = pa.schema([FRAMES.field(name) for name in _COLUMNS])


@dataclass(frozen=True)
class Supervision:
    """Views of the registered training frames, by frame_id, each with its RVA weight (which may be 0)."""

    views: dict[int, View]
    appraisals: list[Appraisal]
    held_back: list[int]
    """Frames that get no repairs, to measure whether those of the others do harm; none where the settings
    hold none back."""

    @property
    def real(self) -> list[View]:
        """The active raw frames: D_real, the held-back ones among them, as for G0."""
        return [view for view in self.views.values() if view.weight > 0.0]

    @property
    def judges(self) -> list[View]:
        """The held-back frames."""
        return [self.views[frame_id] for frame_id in self.held_back]

    def targets(self, which: Targets) -> list[View]:
        """The frames that every round repairs."""
        return [self.views[frame_id] for frame_id in target_frames(self.appraisals, which, self.held_back)]

    def worst(self, frame_ids: Sequence[int], count: int) -> list[View]:
        """The ``count`` views of lowest R - B among ``frame_ids``, worst first."""
        wanted = set(frame_ids)
        ranked = sorted(self.appraisals, key=lambda frame: (frame.R - frame.B, frame.frame_id))
        return [self.views[frame.frame_id] for frame in ranked if frame.frame_id in wanted][:count]


def load_supervision(ingest: Path, rva: Path, held_back: float) -> Supervision:
    """Read the finished folders of ingest and rva; frames that RVA could not score stay out. Decodes no
    image.

    held_back: share of the reliable frames that judge the result.

    Raises StoreError when a table is damaged, StageError when no frame can judge the result.
    """
    frames = {f.frame_id: f for f in load_frames(ingest) if f.registered and f.split == "train"}
    table = read_table(rva / "frames.parquet", _APPRAISED)
    rows = [row for row in table.to_pylist() if row["frame_id"] in frames and row["R"] is not None]
    weights = {row["frame_id"]: row.pop("weight") for row in rows}
    appraisals = sorted((Appraisal(**row) for row in rows), key=lambda frame: frame.frame_id)
    views = {a.frame_id: view_of(frames[a.frame_id], ingest, weights[a.frame_id]) for a in appraisals}
    judges = held_back_frames(appraisals, held_back)
    if held_back > 0.0 and not judges:
        raise StageError(
            "no frame is reliable, and no frame takes the place of one", hint="run rva again with --force rva"
        )
    return Supervision(views, appraisals, judges)
