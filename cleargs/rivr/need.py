"""The frames that image formation and RVA leave in need of a repair.

At least a sixteenth of the frames (and two) are tried, even if none needs a repair: every run has
decisions to inspect.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from typing import Literal, TypeAlias

from cleargs.formation.capture import median_residual
from cleargs.formation.frame import FrameFormation, described
from cleargs.rivr.candidates import EXPLAINED, KEPT
from cleargs.rivr.tables import Selection
from cleargs.rivr.targets import FrameAssessment, Supervision
from cleargs.rva.allocation import Role

Targets: TypeAlias = Literal["auto", "all"]

UNEXPLAINED = 2.0
"""A frame is in need if its residual (mean difference from its render) is above this times the median.
Its weight by the residual is then below `rounds.TRUSTED`."""
MIN_SHARE, MIN_TRIED = 1 / 16, 2
"""Share of the frames, and number of frames, that are tried at least."""


def frames_to_repair(
    which: Targets, supervision: Supervision, formations: Mapping[int, FrameFormation]
) -> list[int]:
    """Return the frames that every round repairs, by frame_id; never a control frame.

    ``which`` is ``all``, or ``auto``: those in need by the ``formations`` of the last training, and the next
    ones up to a sixteenth of the frames.
    """
    frames = supervision.candidates
    if which == "all":
        return [frame.frame_id for frame in frames]
    median = median_residual(formations.values(), {frame.frame_id: frame.weight for frame in frames})

    def order(frame: FrameAssessment) -> tuple[bool, float, float, int]:
        """Return a sort key, neediest frame first. It begins with True where the frame is not in need."""
        formation = formations.get(frame.frame_id, FrameFormation(frame.frame_id))
        residual = formation.residual / median if median > 0.0 else 0.0
        unmodelled = frame.role == Role.REACTIVATED and formation.model == "none"
        in_need = frame.role == Role.SUPPRESSED or residual > UNEXPLAINED or unmodelled
        return not in_need, -residual, frame.R - frame.B, frame.frame_id

    least = max(MIN_TRIED, math.ceil(MIN_SHARE * len(frames)))
    ranked = enumerate(sorted(map(order, frames)))
    return sorted(frame_id for k, (spared, *_, frame_id) in ranked if k < least or not spared)


def untried_rows(
    targets: Collection[int], supervision: Supervision, formations: Mapping[int, FrameFormation]
) -> list[Selection]:
    """Return a row for every frame that no round repairs, with the reason to keep it as filmed."""
    return [
        Selection.not_tried(frame_id, _reason_to_keep(frame_id, supervision, formations.get(frame_id)))
        for frame_id in supervision.views
        if frame_id not in targets
    ]


def _reason_to_keep(frame_id: int, supervision: Supervision, formation: FrameFormation | None) -> str:
    if frame_id in supervision.controls:
        return "not tried: it measures harm"
    if formation is not None and formation.model != "none":
        return f"not tried: {EXPLAINED}{described(formation)}"
    return f"not tried: {KEPT}"
