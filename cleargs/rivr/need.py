"""The frames that image formation and RVA leave in need of a repair.

Candidates are made in every run, so that the decisions about them can be inspected: where few frames are in
need, the next in the order fill up.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, TypeAlias

from cleargs.formation.capture import median_misfit
from cleargs.formation.frame import FrameFormation, described
from cleargs.rivr.candidates import EXPLAINED, KEPT
from cleargs.rivr.tables import Selection
from cleargs.rivr.targets import FrameAssessment, Supervision
from cleargs.rva.allocation import Role

Targets: TypeAlias = Literal["auto", "all"]

UNEXPLAINED = 2.0
"""Misfit over the median misfit from which a frame is in need: it has less than half a weight of trust, see
`rounds.TRUSTED`."""
MIN_SHARE, MIN_TRIED = 1 / 16, 2
"""Share of the frames, and number of frames, that are tried at least."""


@dataclass(frozen=True)
class Need:
    """One frame and the grounds on which it may need a repair."""

    assessment: FrameAssessment
    formation: FrameFormation | None
    """None where the training did not see the frame."""
    relative_misfit: float
    """The frame's misfit over the median of all frames; 0 where it has none."""

    @property
    def reason(self) -> str | None:
        """Why the frame is in need; None where it is not."""
        if self.assessment.role == Role.SUPPRESSED:
            return "suppressed by RVA"
        if self.relative_misfit > UNEXPLAINED:
            return f"misfit of {self.relative_misfit:.1f} times the median"
        modelled = self.formation is not None and self.formation.model != "none"
        if self.assessment.role == Role.REACTIVATED and not modelled:
            return "reactivated by RVA, and no model explains it"
        return None


def ranked_by_need(
    assessments: Sequence[FrameAssessment], formations: Mapping[int, FrameFormation]
) -> list[Need]:
    """Return what each frame needs, neediest first."""
    median = median_misfit(formations.values(), {frame.frame_id: frame.weight for frame in assessments})
    needs = []
    for frame in assessments:
        formation = formations.get(frame.frame_id)
        misfit = 0.0 if formation is None else formation.misfit
        needs.append(Need(frame, formation, misfit / median if median > 0.0 else 0.0))

    def order(need: Need) -> tuple[bool, float, float, int]:
        frame = need.assessment
        return need.reason is None, -need.relative_misfit, frame.R - frame.B, frame.frame_id

    return sorted(needs, key=order)


def frames_to_try(ranked: Sequence[Need]) -> list[int]:
    """Return the frames in need, filled up to a sixteenth of ``ranked``, by frame_id."""
    least = max(MIN_TRIED, math.ceil(MIN_SHARE * len(ranked)))
    return sorted(
        need.assessment.frame_id for k, need in enumerate(ranked) if k < least or need.reason is not None
    )


def frames_to_repair(
    which: Targets, supervision: Supervision, formations: Mapping[int, FrameFormation]
) -> list[int]:
    """Return the frames that every round repairs, by frame_id; never a held-out one.

    ``which`` is ``all``, or ``auto``: those in need by the formations of the training before.
    """
    frames = supervision.candidates
    if which == "auto":
        return frames_to_try(ranked_by_need(frames, formations))
    return [frame.frame_id for frame in frames]


def rows_of_others(
    targets: Collection[int], supervision: Supervision, formations: Mapping[int, FrameFormation]
) -> list[Selection]:
    """Return a row for every frame that no round repairs, which says why it is kept as filmed."""
    return [
        Selection.not_tried(frame_id, _reason_to_keep(frame_id, supervision, formations.get(frame_id)))
        for frame_id in supervision.views
        if frame_id not in targets
    ]


def _reason_to_keep(frame_id: int, supervision: Supervision, formation: FrameFormation | None) -> str:
    if frame_id in supervision.holdout_ids:
        return "not tried: it measures harm"
    if formation is not None and formation.model != "none":
        return f"not tried: {EXPLAINED}{described(formation)}"
    return f"not tried: {KEPT}"
