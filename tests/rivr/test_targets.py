"""Choice of the frames to repair, and of those that measure the result."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from cleargs.formation.frame import FrameFormation
from cleargs.rivr.need import frames_to_repair, untried_rows
from cleargs.rivr.targets import FrameAssessment, Supervision, select_controls


def appraised(roles: list[str], fallback: set[int] | None = None) -> list[FrameAssessment]:
    """One frame a role, with ids 10, 11, ..."""
    return [
        FrameAssessment(
            10 + k, R=0.5, B=0.5, role=role, reliable=role == "strong", fallback=10 + k in (fallback or set())
        )
        for k, role in enumerate(roles)
    ]


ROLES = ["strong", "geometric", "suppressed", "strong", "reactivated", "auxiliary"]


def supervision() -> Supervision:
    """Frame 13 is held out; a number stands for its view."""
    views: Any = {frame_id: frame_id for frame_id in range(10, 16)}
    return Supervision(views, appraised(ROLES), [13])


def test_all_takes_every_frame_but_the_held_back() -> None:
    assert frames_to_repair("all", supervision(), {}) == [10, 11, 12, 14, 15]


def found(**residuals: float) -> dict[int, FrameFormation]:
    """Formations of frames ``f10``, ``f11``, ... with these residuals, of which none has a model."""
    return {
        int(name[1:]): FrameFormation(int(name[1:]), residual=residual)
        for name, residual in residuals.items()
    }


def test_auto_takes_what_formation_and_rva_leave_in_need() -> None:
    """Frame 12 is suppressed, 14 reactivated without a model, 11 has three times the median residual."""
    formations = found(f10=0.01, f11=0.03, f13=0.01, f14=0.01, f15=0.01)
    assert frames_to_repair("auto", supervision(), formations) == [11, 12, 14]
    formations[14] = replace(formations[14], model="blur", blur_px=5.0)
    assert frames_to_repair("auto", supervision(), formations) == [11, 12]


def test_auto_tries_two_frames_at_least_and_a_sixteenth_of_many() -> None:
    few = Supervision({}, appraised(["strong"] * 5), [])
    formations = found(f10=0.012, f11=0.011, f12=0.013, f13=0.01, f14=0.01)
    assert frames_to_repair("auto", few, formations) == [10, 12]
    many = Supervision({}, appraised(["strong"] * 50), [])
    assert len(frames_to_repair("auto", many, {})) == 4


def test_every_frame_that_is_not_tried_says_why_it_is_kept() -> None:
    formations = found(f10=0.01) | {11: FrameFormation(11, model="blur", blur_px=5.2)}
    rows = {row.frame_id: row for row in untried_rows([12, 14, 15], supervision(), formations)}
    assert {frame_id: row.reason for frame_id, row in rows.items()} == {
        10: "not tried: needs no repair",
        11: "not tried: explained: blur 5.2 px",
        13: "not tried: it measures harm",
    }
    assert all(row.exr is None and row.chosen == "observed" and not row.accepted for row in rows.values())


@pytest.mark.parametrize(("strong", "expected"), [(1, 1), (7, 1), (8, 1), (16, 2), (23, 2), (24, 3)])
def test_an_eighth_of_the_strong_frames_is_held_back(strong: int, expected: int) -> None:
    frames = appraised(["strong"] * strong + ["suppressed"] * 5)
    held = select_controls(frames)
    assert len(set(held)) == expected
    assert all(frame_id < 10 + strong for frame_id in held)
    assert held == sorted(held)


def test_held_back_frames_are_spread_over_the_strong_ones() -> None:
    assert select_controls(appraised(["strong"] * 16)) == [14, 22]


def test_the_sharpest_of_each_part_is_held_back() -> None:
    """A soft frame would call a sharper scene worse."""
    frames = appraised(["strong"] * 16)
    frames[2] = replace(frames[2], R=0.9)
    frames[9] = replace(frames[9], R=0.6)
    frames[14] = replace(frames[14], B=0.1)
    assert select_controls(frames) == [12, 24]


def test_the_stand_in_set_replaces_missing_strong_frames() -> None:
    assert select_controls(appraised(["suppressed"] * 5, fallback={12})) == [12]
    assert select_controls(appraised(["strong", "suppressed"], fallback={11})) == [10]
    assert select_controls(appraised(["suppressed"])) == []
