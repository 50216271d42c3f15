"""The share of a frame that something in front of the scene hides."""

from __future__ import annotations

import numpy as np

from cleargs.capture.tables import Frame, Points
from cleargs.rva.assessment import Observations
from cleargs.rva.hidden import hidden_shares, with_hidden_parts
from cleargs.rva.tables import CUE_COLUMNS
from cleargs.types import ArrayBool, ArrayF64

FRAMES, WIDTH, HEIGHT = 7, 160, 100
ROWS, COLUMNS = np.mgrid[0:10, 0:16]
ACROSS, DOWN = (COLUMNS.ravel() + 0.5) / 16, (ROWS.ravel() + 0.5) / 10
"""Points on a wall: four in each part of a frame."""


def frame(number: int, registered: bool = True) -> Frame:
    still = {"qw": 1.0, **dict.fromkeys(("qx", "qy", "qz", "tx", "ty", "tz"), 0.0)}
    lens = {"fx": 100.0, "fy": 100.0, "cx": WIDTH / 2, "cy": HEIGHT / 2, "width": WIDTH, "height": HEIGHT}
    names = {"name": f"{number}", "image": f"{number}.png", "time_s": None, "placed": None, "mask": None}
    return Frame(frame_id=number, registered=registered, n_points=0, split="train", **names, **lens, **still)


def wall() -> Points:
    xyz = np.stack([(ACROSS - 0.5) * WIDTH / 100, (DOWN - 0.5) * HEIGHT / 100, np.ones(160)], axis=1)
    number = np.arange(160)
    return Points(number, xyz, np.zeros((160, 3), np.uint8), np.zeros(160), np.zeros(160, np.int32))


def observations(seen: ArrayBool) -> Observations:  # [FRAMES, 160]
    return Observations(*np.nonzero(seen))


def shares(seen: ArrayBool) -> ArrayF64:
    points = wall()
    return hidden_shares([frame(k) for k in range(FRAMES)], points.point_id, points.xyz, observations(seen))


def everything() -> ArrayBool:
    return np.ones((FRAMES, 160), np.bool_)


def test_a_person_in_front_of_the_scene_hides_a_share() -> None:
    seen = everything()
    seen[3] = ACROSS > 0.25
    np.testing.assert_allclose(shares(seen), [0, 0, 0, 0.25, 0, 0, 0])
    seen[4] = ACROSS > 0.5
    np.testing.assert_allclose(shares(seen), [0, 0, 0, 0.25, 0.5, 0, 0])


def test_blur_loses_points_everywhere_and_hides_nothing() -> None:
    seen = everything()
    rng = np.random.default_rng(0)
    seen[2], seen[3], seen[4] = rng.random((3, 160)) < np.array([[0.7], [0.2], [0.02]])
    assert shares(seen).max() <= 0.1


def test_what_leaves_the_view_for_good_is_not_hidden() -> None:
    seen = everything()
    seen[3:, ACROSS < 0.5] = False
    assert not shares(seen).any()


def test_the_larger_ghosting_holds_and_frames_without_score_or_pose_stay() -> None:
    seen = everything()
    seen[3] = ACROSS > 0.5
    cues = np.full((FRAMES, len(CUE_COLUMNS)), 0.2)
    cues[5] = np.nan
    frames = [frame(k, registered=k != 1) for k in range(FRAMES)]
    ghosting = CUE_COLUMNS.index("b_ghosting")
    found = with_hidden_parts(cues, frames, wall(), observations(seen))
    # (0.5 - 0.15) / (0.6 - 0.15)
    np.testing.assert_allclose(found[:, ghosting], [0.2, 0.2, 0.2, 7 / 9, 0.2, np.nan, 0.2])
    np.testing.assert_array_equal(np.delete(found, ghosting, axis=1), np.delete(cues, ghosting, axis=1))
