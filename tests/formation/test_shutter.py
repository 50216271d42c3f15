"""A rolling shutter, by the frames of a capture together; and the skew that its frames have in common."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cleargs.capture.tables import Frame
from cleargs.formation.frame import FrameFormation
from cleargs.formation.motion import FrameMotion, Model
from cleargs.formation.shutter import MAX_TESTED_FRAMES, CameraSpeeds, frames_to_test, rolls, with_skew
from cleargs.scene.views import view_of
from cleargs.splat.camera import Camera, look_at
from cleargs.splat.views import TrainingView
from cleargs.types import ArrayF64

FRAMES, INTERVAL, READOUT, FOCAL, DEPTH = 16, 0.2, 0.05, 250.0, 2.0
NEEDED = np.array([-4.0, 0.5, 0.0, 0.5, 4.0, 0.5])  # the part of the skews that the scene has taken up, px
REST = np.array([DEPTH] * 3 + [1.0] * 3)  # from px to world units times the focal length


def camera(time: float) -> Camera:
    """A walk around a table at an uneven pace and height, with a view that wanders."""
    angle = 0.3 * time + 0.03 * np.sin(3.0 * time)
    place = np.array([2.0 * np.sin(angle), 0.1 * np.sin(2.0 * time), -2.0 * np.cos(angle)])
    target = np.array([0.3 * np.sin(2.0 * time), 0.2 * np.sin(1.5 * time), 0.0])
    pose = look_at(place, target, np.array([0.0, -1.0, 0.0]))
    return Camera(320, 180, FOCAL, FOCAL, 160.0, 90.0, pose)


def skew(time: float) -> ArrayF64:
    """The motion of the scene past the camera during the readout, px at the depth of 2."""
    first, last = (camera(time + side * READOUT / 2).world_to_camera for side in (-1, 1))
    moved = last @ np.linalg.inv(first)
    return FOCAL * np.concatenate([moved[:3, 3] / DEPTH, [moved[2, 1], moved[0, 2], moved[1, 0]]])


def walk(times: ArrayF64) -> list[TrainingView]:
    return [
        TrainingView(k, camera(time), 1.0, "real", lambda: (np.zeros((180, 320, 3)), None), time=time)
        for k, time in enumerate(times)
    ]


def skewed(times: ArrayF64, lacking: ArrayF64) -> dict[int, FrameFormation]:
    motions = [FrameMotion(skew=skew(time) - lacking, median_depth=DEPTH) for time in times]
    return {k: FrameFormation(k, motion, "skew") for k, motion in enumerate(motions)}


TIMES = INTERVAL * np.arange(FRAMES)


def test_the_common_skew_follows_from_the_speeds() -> None:
    """The skews lack 4 px to the side and as much of a turn, which nearly cancel in the image."""
    speeds = CameraSpeeds.of(walk(TIMES))
    assert speeds is not None and len(speeds.per_frame) == FRAMES - 2
    found = speeds.missing_skew(skewed(TIMES, NEEDED))
    assert found is not None
    # 0.03 px measured: the spline follows the pace to a percent.
    np.testing.assert_allclose(found / REST, NEEDED, atol=0.1)
    none = speeds.missing_skew(skewed(TIMES, np.zeros(6)))
    assert none is not None
    np.testing.assert_allclose(none / REST, 0.0, atol=0.1)


def test_tremor_changes_the_common_skew_little() -> None:
    rng = np.random.default_rng(0)
    speeds = CameraSpeeds.of(walk(TIMES))
    assert speeds is not None
    errors = []
    for _ in range(20):
        frames = skewed(TIMES, NEEDED)
        for k, frame in frames.items():
            tremor = rng.normal(0.0, 1.0, 6)  # skews vary by 2 px without it
            frames[k] = replace(frame, motion=replace(frame.motion, skew=frame.motion.skew + tremor))
        found = speeds.missing_skew(frames)
        if found is not None:
            errors.append(np.abs(found / REST - NEEDED).max())
    assert len(errors) >= 18
    assert np.median(errors) < 1.2  # 0.6 px measured, of 4 px


def test_skews_that_do_not_follow_the_speeds_tell_nothing() -> None:
    speeds, rng = CameraSpeeds.of(walk(TIMES)), np.random.default_rng(1)
    assert speeds is not None
    frames = skewed(TIMES, NEEDED)
    other = {k: replace(f, motion=replace(f.motion, skew=rng.normal(0, 3, 6))) for k, f in frames.items()}
    assert speeds.missing_skew(other) is None
    backwards = {k: replace(f, motion=replace(f.motion, skew=-f.motion.skew)) for k, f in frames.items()}
    assert speeds.missing_skew(backwards) is None
    still = {k: FrameFormation(k, FrameMotion(median_depth=DEPTH)) for k in frames}
    assert speeds.missing_skew(still) is None


def test_a_readout_longer_than_the_time_between_frames_is_not_taken() -> None:
    """If the speed varies by little, errors of the skews give a steep slope."""
    speeds = CameraSpeeds.of(walk(TIMES))
    assert speeds is not None
    for factor, known in ((0.9, True), (1.1, False)):
        frames = skewed(TIMES, np.zeros(6))
        for k, frame in frames.items():
            slow = factor * INTERVAL / READOUT * frame.motion.skew
            frames[k] = replace(frame, motion=replace(frame.motion, skew=slow))
        assert (speeds.missing_skew(frames) is not None) == known


def test_few_frames_or_unknown_times_give_no_speed() -> None:
    assert CameraSpeeds.of(walk(TIMES[:9])) is None
    assert CameraSpeeds.of([replace(view, time=float("nan")) for view in walk(TIMES)]) is None
    assert CameraSpeeds.of(walk(np.concatenate([TIMES[:8], TIMES[:8]]))) is None, "two videos"
    speeds = CameraSpeeds.of(walk(TIMES))
    assert speeds is not None
    few = skewed(TIMES, NEEDED)
    few |= {k: replace(frame, model="defocus") for k, frame in few.items() if k > 7}  # seven are left
    assert speeds.missing_skew(few) is None


def test_a_frame_at_a_long_or_a_short_gap_has_no_speed() -> None:
    speeds = CameraSpeeds.of(walk(np.concatenate([TIMES[:8], TIMES[11:], TIMES[11:] + 1.2])))
    assert speeds is not None
    assert sorted(speeds.per_frame) == [*range(1, 7), *range(9, 12), *range(14, 17)]
    speeds = CameraSpeeds.of(walk(np.sort(np.append(TIMES, TIMES[5] + 0.01))))
    assert speeds is not None
    assert sorted(speeds.per_frame) == [*range(1, 5), *range(7, FRAMES)]


@pytest.mark.parametrize(
    ("before", "after"), [("none", "skew"), ("blur", "both"), ("skew", "skew"), ("both", "both")]
)
def test_a_skew_is_added_to_what_a_frame_has(before: Model, after: Model) -> None:
    had = FrameMotion(skew=np.full(6, 0.5), median_depth=DEPTH)
    frame = with_skew(FrameFormation(3, had, before, displacement_px=2.0), NEEDED * REST)
    assert frame.model == after
    np.testing.assert_allclose(frame.motion.skew, NEEDED + 0.5)
    assert frame.displacement_px == 2.0 + 0.5 * 9.5, "no pixel at the median depth moves farther"


def test_a_defocused_frame_stays_as_it_is() -> None:
    frame = FrameFormation(3, FrameMotion(disc_px=3.0), "defocus")
    assert with_skew(frame, NEEDED) is frame


@pytest.mark.parametrize(("clock", "time"), [(1.25, 1.25), (None, 7.0)])
def test_a_view_has_the_time_of_its_frame_or_its_place(clock: float | None, time: float) -> None:
    lens = {"width": 100, "height": 50, "fx": 80.0, "fy": 80.0, "cx": 50.0, "cy": 25.0}
    pose = {"qw": 1.0, "qx": 0.0, "qy": 0.0, "qz": 0.0, "tx": 0.0, "ty": 0.0, "tz": 0.0}
    known = {"registered": True, "n_points": 9, "split": "train", "placed": "sfm", "mask": None}
    frame = Frame(frame_id=7, name="a", image="images/a.png", time_s=clock, **lens, **pose, **known)
    assert view_of(frame, Path(), 1.0).time == time


def test_some_frames_spread_evenly_are_tested() -> None:
    assert frames_to_test(3) == [0, 1, 2]
    assert frames_to_test(10) == [1, 3, 5, 7, 9]
    many = frames_to_test(150)
    assert len(many) == MAX_TESTED_FRAMES and many[0] == 4 and many[-1] == 145


def test_few_frames_or_little_gain_tell_no_rolling_shutter() -> None:
    def tested(gains: list[float | None]) -> list[FrameFormation]:
        return [FrameFormation(k, skew_gain=gain) for k, gain in enumerate(gains)]

    assert rolls(tested([0.2, 0.1, 0.1, 0.3]))
    assert not rolls(tested([0.2, 0.1, 0.1]))
    assert not rolls(tested([0.2, 0.1, 0.1, None]))
    assert not rolls(tested([0.4, 0.4, 0.0, 0.0, 0.0]))
