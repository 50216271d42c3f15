"""The frames of a capture in RIVR and the consolidation: those to repair, and those that measure harm."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from itertools import pairwise
from pathlib import Path

import pyarrow as pa

from cleargs.capture.tables import load_frames
from cleargs.errors import StageError
from cleargs.parquet import read_table
from cleargs.rva.tables import FRAMES
from cleargs.scene.views import view_of
from cleargs.splat.views import TrainingView


@dataclass(frozen=True)
class FrameAssessment:
    """RVA's scores and role of a frame."""

    frame_id: int
    R: float
    B: float
    role: str
    reliable: bool
    """True if the frame is in RVA's reliable set A: R >= tau_R and B <= tau_B, with any role."""
    fallback: bool
    """True if no frame is reliable and this one is among the best by R - B."""
    weight: float = 1.0
    """Weight of the frame's raw supervision; a frame of weight 0 is never loaded."""


def select_controls(frames: Sequence[FrameAssessment], share: float = 0.125) -> list[int]:
    """Select the control frames, which get no repair and measure harm by the repairs of others, in order.

    They are a ``share`` (at least one; none for 0) of the reliable frames, or of the fallbacks if there are
    none. These are divided, in order, into that many nearly equal parts. The best frame of each part by R - B
    is selected, or among equals the nearest to the middle of the part. Soft frames are not selected, since
    they would count every gain in sharpness as a loss.
    """
    reliable = [frame for frame in frames if frame.reliable]
    references = reliable or [frame for frame in frames if frame.fallback]
    if not references or share == 0.0:
        return []
    count = max(1, int(len(references) * share))
    return [_best(references[start:end]).frame_id for start, end in _parts(len(references), count)]


def _parts(count: int, parts: int) -> Iterator[tuple[int, int]]:
    """Yield start and end of each of ``parts`` nearly equal parts of ``count`` things in a row."""
    return pairwise(k * count // parts for k in range(parts + 1))


def _best(frames: Sequence[FrameAssessment]) -> FrameAssessment:
    middle = len(frames) // 2
    return min(enumerate(frames), key=lambda item: (item[1].B - item[1].R, abs(item[0] - middle)))[1]


@dataclass(frozen=True)
class FrameGroup:
    """Target frames that are rendered from one scene."""

    targets: Sequence[TrainingView]
    steps: int
    """Steps of the distillation after these frames, on all that was accepted so far."""


def trajectory_groups(targets: Sequence[TrainingView], size: int | None, steps: int) -> list[FrameGroup]:
    """Divide ``targets``, in their order, into the fewest groups of at most ``size`` frames (None: one).

    The paper repairs along the trajectory: repairs of early frames are distilled before later frames are
    rendered. Sizes differ by one at most. The ``steps`` of the round are shared in proportion to the frames
    and add up exactly. The distillation of a group is a separate training, in its part of the schedule.
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
    controls: list[int]
    """Control frames, which get no repair and measure the harm by the repairs of others."""

    @property
    def real(self) -> list[TrainingView]:
        """The active frame images D_real, including the control frames, as for G0."""
        return [view for view in self.views.values() if view.weight > 0.0]

    @property
    def candidates(self) -> list[FrameAssessment]:
        """The frames that may be repaired: all except the control frames."""
        return [frame for frame in self.assessments if frame.frame_id not in self.controls]


def load_supervision(ingest: Path, rva: Path, share: float) -> Supervision:
    """Read the finished folders of ingest and rva, without frames that RVA could not score. Decode no image.

    Raises:
        StoreError: A table is damaged.
        StageError: No frame can measure harm.
    """
    frames = {f.frame_id: f for f in load_frames(ingest) if f.registered and f.split == "train"}
    columns = pa.schema([FRAMES.field(field.name) for field in fields(FrameAssessment)])
    rows = [FrameAssessment(**row) for row in read_table(rva / "frames.parquet", columns).to_pylist()]
    scored = [row for row in rows if row.frame_id in frames and row.R is not None]
    assessments = sorted(scored, key=lambda frame: frame.frame_id)
    views = {a.frame_id: view_of(frames[a.frame_id], ingest, a.weight) for a in assessments}
    controls = select_controls(assessments, share)
    if share > 0.0 and not controls:
        raise StageError(
            "no frame is reliable, and no frame takes the place of one", hint="run rva again with --force rva"
        )
    return Supervision(views, assessments, controls)
