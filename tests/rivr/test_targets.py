"""Which frames are repaired, and which judge the result."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from cleargs.rivr.targets import FrameAssessment, Supervision, select_holdout


def appraised(roles: list[str], stand_in: set[int] | None = None) -> list[FrameAssessment]:
    """One frame a role, with ids 10, 11, ..."""
    return [
        FrameAssessment(
            10 + k, R=0.5, B=0.5, role=role, reliable=role == "strong", stand_in=10 + k in (stand_in or set())
        )
        for k, role in enumerate(roles)
    ]


ROLES = ["strong", "geometric", "suppressed", "strong", "reactivated", "auxiliary"]


def supervision() -> Supervision:
    """Frame 13 is held back; a number stands for its view."""
    views: Any = {frame_id: frame_id for frame_id in range(10, 16)}
    return Supervision(views, appraised(ROLES), [13])


def test_all_takes_every_frame_but_the_held_back() -> None:
    assert supervision().targets("all") == [10, 11, 12, 14, 15]


def test_degraded_leaves_the_strong_ones_out() -> None:
    assert supervision().targets("degraded") == [11, 12, 14, 15]


@pytest.mark.parametrize(("strong", "expected"), [(1, 1), (7, 1), (8, 1), (16, 2), (23, 2), (24, 3)])
def test_an_eighth_of_the_strong_frames_is_held_back(strong: int, expected: int) -> None:
    frames = appraised(["strong"] * strong + ["suppressed"] * 5)
    held = select_holdout(frames)
    assert len(set(held)) == expected
    assert all(frame_id < 10 + strong for frame_id in held)
    assert held == sorted(held)


def test_held_back_frames_are_spread_over_the_strong_ones() -> None:
    assert select_holdout(appraised(["strong"] * 16)) == [14, 22]


def test_the_sharpest_of_each_part_is_held_back() -> None:
    """A soft frame would call a sharper scene worse."""
    frames = appraised(["strong"] * 16)
    frames[2] = replace(frames[2], R=0.9)
    frames[9] = replace(frames[9], R=0.6)
    frames[14] = replace(frames[14], B=0.1)
    assert select_holdout(frames) == [12, 24]


def test_the_stand_in_set_replaces_missing_strong_frames() -> None:
    assert select_holdout(appraised(["suppressed"] * 5, stand_in={12})) == [12]
    assert select_holdout(appraised(["strong", "suppressed"], stand_in={11})) == [10]
    assert select_holdout(appraised(["suppressed"])) == []
