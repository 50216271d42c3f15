"""Which frames RIVR repairs, and which it holds back to measure whether repairing does harm."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal, TypeAlias

Targets: TypeAlias = Literal["all", "degraded"]


@dataclass(frozen=True)
class Appraisal:
    """What RVA says about a frame."""

    frame_id: int
    R: float
    B: float
    role: str
    reliable: bool
    """With RVA on, the strong frames; in the all-view ablation, where all are strong, the sharp ones."""
    stand_in: bool
    """No frame is reliable, and this one is among the best by R - B."""


def target_frames(frames: Sequence[Appraisal], which: Targets, held_back: Collection[int]) -> list[int]:
    """The frames that every round visits, in order.

    frames: the registered training frames by frame_id. ``all`` takes each of them, ``degraded`` those whose
    role is not ``strong``; ``held_back`` ones are never taken.
    """
    return [
        frame.frame_id
        for frame in frames
        if frame.frame_id not in held_back and (which == "all" or frame.role != "strong")
    ]


def held_back_frames(frames: Sequence[Appraisal], share: float = 0.125) -> list[int]:
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
    borders = [k * len(references) // count for k in range(count + 1)]
    return [_best(references[start:end]).frame_id for start, end in pairwise(borders)]


def _best(frames: Sequence[Appraisal]) -> Appraisal:
    middle = len(frames) // 2
    ranked = sorted(enumerate(frames), key=lambda item: (item[1].B - item[1].R, abs(item[0] - middle)))
    return ranked[0][1]
