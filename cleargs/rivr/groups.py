"""Along the trajectory: a round's target frames in groups, which share the steps of its distillation.

The paper repairs along the trajectory: what is accepted early is distilled before later frames are rendered,
and may fade while theirs are. That is what the consolidation is for.

Each group's distillation is a training of its own, in its part of the schedule. Over one of two rounds the
means' rate falls by a fifth, so that the end of the trajectory gets its geometry too.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

from cleargs.splat.views import View


@dataclass(frozen=True)
class Group:
    """Target frames that are rendered from one scene."""

    targets: Sequence[View]
    steps: int
    """Steps of the distillation of what was accepted so far, after its frames."""


def trajectory_groups(targets: Sequence[View], size: int | None, steps: int) -> list[Group]:
    """``targets`` in their order, in as few groups of at most ``size`` frames as hold them, all in one for
    None; sizes differ by one at most. ``steps`` is shared in proportion to the frames and adds up exactly.
    """
    frames = len(targets)
    count = 1 if size is None else max(1, -(-frames // size))
    borders = [k * frames // count for k in range(count + 1)]
    return [
        Group(targets[start:end], steps * end // frames - steps * start // frames if frames else steps)
        for start, end in pairwise(borders)
    ]
