"""The frames of a capture as RIVR and the consolidation see them: those that are repaired, in groups along
the trajectory, and those that are held back to measure whether repairing does harm.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from itertools import pairwise
from pathlib import Path
from typing import Literal, TypeAlias

import pyarrow as pa

from cleargs.capture.tables import load_frames
from cleargs.errors import StageError
from cleargs.formation.frames import view_of
from cleargs.parquet import read_table
from cleargs.rva.tables import FRAMES
from cleargs.splat.views import TrainingView

Targets: TypeAlias = Literal["all", "degraded"]


@dataclass(frozen=True)
class FrameAssessment:
    """What RVA says about a frame."""

    frame_id: int
    R: float
    B: float
    role: str
    reliable: bool
    """With RVA on, the strong frames; in the all-view ablation, where all are strong, the sharp ones."""
    stand_in: bool
    """No frame is reliable, and this one is among the best by R - B."""
    weight: float = 1.0
    """Of the frame's raw supervision; 0: it is never loaded."""


def select_holdout(frames: Sequence[FrameAssessment], share: float = 0.125) -> list[int]:
    """A share (at least one; none for 0) of the reliable frames: the best by R - B of each of as many equal
    parts of the trajectory (ties: the one nearest to the part's middle); in order.

    Where no frame is reliable, the stand-in set takes their place. These frames get no repairs, and judge
    the scene distilled from those of the others: a frame that is itself a little soft would call every gain
    in sharpness a loss. Empty when RVA names neither.
    """
    references = [frame for frame in frames if frame.reliable] or [
        frame for frame in frames if frame.stand_in
    ]
    if not references or share == 0.0:
        return []
    count = max(1, int(len(references) * share))
    return [_best(references[start:end]).frame_id for start, end in _parts(len(references), count)]


def _parts(count: int, parts: int) -> Iterator[tuple[int, int]]:
    """Start and end of each of so many nearly equal parts of ``count`` things in a row."""
    return pairwise(k * count // parts for k in range(parts + 1))


def _best(frames: Sequence[FrameAssessment]) -> FrameAssessment:
    middle = len(frames) // 2
    ranked = sorted(enumerate(frames), key=lambda item: (item[1].B - item[1].R, abs(item[0] - middle)))
    return ranked[0][1]


@dataclass(frozen=True)
class FrameGroup:
    """Target frames that are rendered from one scene."""

    targets: Sequence[TrainingView]
    steps: int
    """Steps of the distillation of what was accepted so far, after its frames."""


def trajectory_groups(targets: Sequence[TrainingView], size: int | None, steps: int) -> list[FrameGroup]:
    """``targets`` in their order, in as few groups of at most ``size`` frames as hold them, all in one for
    None; sizes differ by one at most. ``steps`` is shared in proportion to the frames and adds up exactly.

    The paper repairs along the trajectory: what is accepted early is distilled before later frames are
    rendered, and may fade while theirs are. That is what the consolidation is for. Each group's distillation
    is a training of its own, in its part of the schedule: over one of two rounds the means' rate falls by a
    fifth, so that the end of the trajectory gets its geometry too.
    """
    frames = len(targets)
    count = 1 if size is None else max(1, -(-frames // size))
    return [
        FrameGroup(targets[start:end], steps * end // frames - steps * start // frames if frames else steps)
        for start, end in _parts(frames, count)
    ]


@dataclass(frozen=True)
class Supervision:
    """Views of the registered training frames, by frame_id, each with its RVA weight (which may be 0)."""

    views: dict[int, TrainingView]
    assessments: list[FrameAssessment]
    holdout_ids: list[int]
    """Frames that get no repairs, to measure whether those of the others do harm; none where the settings
    hold none back."""

    @property
    def real(self) -> list[TrainingView]:
        """The active raw frames: D_real, the held-back ones among them, as for G0."""
        return [view for view in self.views.values() if view.weight > 0.0]

    @property
    def holdout_views(self) -> list[TrainingView]:
        """The held-back frames."""
        return [self.views[frame_id] for frame_id in self.holdout_ids]

    def targets(self, which: Targets) -> list[TrainingView]:
        """The frames that every round repairs: ``all``, or those whose role is not ``strong``, but never the
        held-back ones.
        """
        return [
            self.views[frame.frame_id]
            for frame in self.assessments
            if frame.frame_id not in self.holdout_ids and (which == "all" or frame.role != "strong")
        ]

    def worst(self, frame_ids: Sequence[int], count: int) -> list[TrainingView]:
        """The ``count`` views of lowest R - B among ``frame_ids``, worst first."""
        wanted = set(frame_ids)
        ranked = sorted(self.assessments, key=lambda frame: (frame.R - frame.B, frame.frame_id))
        return [self.views[frame.frame_id] for frame in ranked if frame.frame_id in wanted][:count]


def load_supervision(ingest: Path, rva: Path, holdout_share: float) -> Supervision:
    """Read the finished folders of ingest and rva; frames that RVA could not score stay out. Decodes no
    image.

    holdout_share: share of the reliable frames that judge the result.

    Raises StoreError when a table is damaged, StageError when no frame can judge the result.
    """
    frames = {f.frame_id: f for f in load_frames(ingest) if f.registered and f.split == "train"}
    columns = pa.schema([FRAMES.field(field.name) for field in fields(FrameAssessment)])
    rows = [FrameAssessment(**row) for row in read_table(rva / "frames.parquet", columns).to_pylist()]
    scored = [row for row in rows if row.frame_id in frames and row.R is not None]
    assessments = sorted(scored, key=lambda frame: frame.frame_id)
    views = {a.frame_id: view_of(frames[a.frame_id], ingest, a.weight) for a in assessments}
    holdout_ids = select_holdout(assessments, holdout_share)
    if holdout_share > 0.0 and not holdout_ids:
        raise StageError(
            "no frame is reliable, and no frame takes the place of one", hint="run rva again with --force rva"
        )
    return Supervision(views, assessments, holdout_ids)
