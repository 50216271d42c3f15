"""Camera paths: ends, equal steps and rotations, and circles around the point that the cameras look at."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from cleargs.errors import InputError
from cleargs.render.paths import framed, seen_point, smooth_path, turntable, up_axis
from cleargs.splat.camera import Camera, look_at
from cleargs.types import ArrayF64

UP = np.array([0.0, -1.0, 0.0])


def camera(pose: ArrayF64) -> Camera:
    return Camera(96, 54, 90.0, 90.0, 47.0, 28.0, pose)


def around(target: ArrayF64, angles: ArrayF64, radius: float = 2.0, height: float = 0.5) -> list[Camera]:
    """Cameras on a circle about the vertical through ``target``, which they look at."""
    positions = [target + np.array([radius * np.cos(a), -height, radius * np.sin(a)]) for a in angles]
    return [camera(look_at(position, target, UP)) for position in positions]


def handheld(seed: int, count: int = 40) -> list[Camera]:
    """A walk with shake from frame to frame."""
    chance = np.random.default_rng(seed)
    cameras = []
    for t in np.linspace(0, 1, count):
        turn = Rotation.from_euler("yxz", [90 * t, 10 * np.sin(5 * t), 0], degrees=True)
        turn *= Rotation.from_rotvec(chance.normal(0, 0.01, 3))
        pose = np.eye(4)
        pose[:3, :3] = turn.inv().as_matrix()
        pose[:3, 3] = -pose[:3, :3] @ (
            np.array([3 * t, 0.2 * np.sin(9 * t), t * t]) + chance.normal(0, 0.01, 3)
        )
        cameras.append(camera(pose))
    return cameras


def centres(poses: ArrayF64) -> ArrayF64:
    return -np.einsum("kji,kj->ki", poses[:, :3, :3], poses[:, :3, 3])


def steps(poses: ArrayF64) -> ArrayF64:
    """Length of each step as in `smooth_path`: distance divided by extent, plus angle divided by pi."""
    places, turns = centres(poses), Rotation.from_matrix(poses[:, :3, :3])
    distance = np.linalg.norm(np.diff(places, axis=0), axis=1) / np.linalg.norm(np.ptp(places, axis=0))
    return np.asarray(distance + (turns[1:] * turns[:-1].inv()).magnitude() / np.pi)


def bends(places: ArrayF64) -> float:
    """Mean second difference divided by the mean step, a measure of shake."""
    return float(np.abs(np.diff(places, 2, axis=0)).mean() / np.abs(np.diff(places, axis=0)).mean())


def as_poses(cameras: Sequence[Camera]) -> ArrayF64:
    return np.stack([each.world_to_camera for each in cameras])


@settings(deadline=None, max_examples=20)
@given(seed=st.integers(0, 10**6), frames=st.integers(2, 60), count=st.integers(2, 200))
def test_the_path_begins_and_ends_where_the_capture_does(seed: int, frames: int, count: int) -> None:
    cameras = handheld(seed, frames)
    poses, nearest = smooth_path(cameras, count)
    assert poses.shape == (count, 4, 4)
    np.testing.assert_allclose(poses[0], cameras[0].world_to_camera, atol=1e-9)
    np.testing.assert_allclose(poses[-1], cameras[-1].world_to_camera, atol=1e-9)
    assert nearest[0] == 0 and nearest[-1] == frames - 1
    assert (np.diff(nearest) >= 0).all()
    turns = poses[:, :3, :3]
    np.testing.assert_allclose(turns @ turns.transpose(0, 2, 1), np.tile(np.eye(3), (count, 1, 1)), atol=1e-9)
    np.testing.assert_allclose(np.linalg.det(turns), 1.0)


@pytest.mark.parametrize("seed", range(3))
def test_the_camera_keeps_its_pace(seed: int) -> None:
    """The speed is constant although the capture is three times as fast in its second half."""
    cameras = handheld(seed, 60)
    made = steps(smooth_path(cameras[:30] + cameras[30::3], 50)[0])
    # Steps are chords of a smooth curve, which are shorter than the curve by some thousandths.
    np.testing.assert_allclose(made, made.mean(), rtol=0.02)


@pytest.mark.parametrize("seed", range(3))
def test_shake_is_removed_and_the_path_is_kept(seed: int) -> None:
    cameras = handheld(seed, 60)
    raw = np.stack([each.centre for each in cameras])
    made = centres(smooth_path(cameras, 60)[0])
    assert bends(made) < 0.2 * bends(raw)
    # The shake is 0.01 per axis. The filter shortens curves by a similar length.
    nearest = np.linalg.norm(made[:, None] - raw, axis=2).min(axis=1)
    assert nearest.max() < 0.08


def test_a_camera_that_stops_and_turns_takes_its_time() -> None:
    """Half a turn on the spot, then a straight walk: the rotation per image is limited."""
    turning = [Rotation.from_euler("y", angle, degrees=True) for angle in np.linspace(0, 180, 20)]
    poses = np.tile(np.eye(4), (40, 1, 1))
    poses[:20, :3, :3] = [turn.as_matrix() for turn in turning]
    poses[20:, :3, :3] = turning[-1].as_matrix()
    walked = np.stack([np.linspace(0.1, 2, 20), np.zeros(20), np.zeros(20)], 1)
    poses[20:, :3, 3] = -np.einsum("kij,kj->ki", poses[20:, :3, :3], walked)
    made = smooth_path([camera(pose) for pose in poses], 100)[0]
    turns = Rotation.from_matrix(made[:, :3, :3])
    assert np.degrees((turns[1:] * turns[:-1].inv()).magnitude()).max() < 5
    np.testing.assert_allclose(steps(made), steps(made).mean(), rtol=0.02)


def test_frames_at_one_place_and_repeated_frames() -> None:
    cameras = handheld(0, 5)
    twice = [cameras[0], cameras[0], *cameras[1:], cameras[-1]]
    np.testing.assert_allclose(smooth_path(twice, 20)[0][-1], cameras[-1].world_to_camera, atol=1e-9)
    with pytest.raises(InputError, match="do not move"):
        smooth_path([cameras[0]] * 4, 20)


def test_a_camera_goes_back_and_forth() -> None:
    there = handheld(1, 4)
    poses, _ = smooth_path([*there, *there[-2::-1]], 41)
    assert np.isfinite(poses).all()
    np.testing.assert_allclose(poses, poses[::-1], atol=1e-9)


def test_opposite_signs_of_a_quaternion_are_one_rotation() -> None:
    """Two and a half turns about one axis: all steps have the same direction."""
    angles = np.linspace(0, 900, 60)
    cameras = []
    for index, angle in enumerate(angles):
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_euler("y", angle, degrees=True).as_matrix()
        pose[:3, 3] = -pose[:3, :3] @ [0.01 * index, 0, 0]
        cameras.append(camera(pose))
    made = Rotation.from_matrix(smooth_path(cameras, 200)[0][:, :3, :3])
    turned = (made[1:] * made[:-1].inv()).as_rotvec(degrees=True)
    np.testing.assert_allclose(turned[:, 1], 900 / 199, rtol=0.05)


@settings(deadline=None, max_examples=20)
@given(
    target=st.tuples(*[st.floats(-5, 5)] * 3).map(np.array), first=st.floats(0, 6), count=st.integers(3, 100)
)
def test_a_turntable_looks_at_the_centre(target: ArrayF64, first: float, count: int) -> None:
    cameras = around(target, first + 2 * np.pi * np.arange(12) / 12)
    np.testing.assert_allclose(seen_point(cameras), target, atol=1e-6)
    poses = turntable(cameras, count)
    ahead = target - centres(poses)
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    np.testing.assert_allclose(poses[:, 2, :3], ahead, atol=1e-6)
    np.testing.assert_allclose(centres(poses)[0], cameras[0].centre, atol=1e-6)
    offsets = centres(poses) - target
    np.testing.assert_allclose(offsets[:, 1], -0.5, atol=1e-6)  # y points down
    np.testing.assert_allclose(np.linalg.norm(offsets[:, [0, 2]], axis=1), 2.0, atol=1e-6)
    turns = Rotation.from_matrix(poses[:, :3, :3])
    angles = (turns * Rotation.concatenate([turns[1:], turns[:1]]).inv()).magnitude()
    # All steps are equal, also from the last pose to the first, so that the film can loop. The cameras look
    # down by 14 degrees, so they rotate a little less than the turntable.
    np.testing.assert_allclose(angles, angles[0], atol=1e-6)
    np.testing.assert_allclose(np.linalg.det(poses[:, :3, :3]), 1.0)
    assert (poses[:, 1, :3] @ UP < 0).all()  # upright


def test_cameras_on_one_side_do_not_tilt_the_turntable() -> None:
    """Cameras on half a circle look down: the mean of their up vectors is tilted by about 9 degrees."""
    cameras = around(np.zeros(3), np.linspace(0, np.pi, 12))
    own = -np.mean([each.world_to_camera[1, :3] for each in cameras], axis=0)
    assert np.degrees(np.arccos(own @ UP / np.linalg.norm(own))) > 8
    assert np.degrees(np.arccos(up_axis(cameras) @ UP)) < 0.2
    # Cameras with equal horizontal axes: only their up vectors decide.
    same = [look_at(np.array([x, 0.0, 0]), np.array([x, 0.0, 1]), UP) for x in range(4)]
    np.testing.assert_allclose(up_axis([camera(pose) for pose in same]), UP, atol=1e-9)


@pytest.mark.parametrize("first", [0, 5, 11])
@pytest.mark.parametrize("begin", [0.3, 2.0, 3.0, 5.0])
def test_a_turntable_of_cameras_on_one_side_stays_there(begin: float, first: int) -> None:
    """The path goes back and forth over the third of a turn that was seen, and starts at the first camera."""
    cameras = around(np.zeros(3), begin + np.linspace(0, 2 * np.pi / 3, 12))
    poses = turntable([cameras[first], *cameras], 240)
    # The up axis has an error of 0.02 degrees, since the cameras do not form a full circle.
    np.testing.assert_allclose(centres(poses)[0], cameras[first].centre, atol=2e-3)
    seen = np.stack([each.centre for each in cameras])

    def from_middle(positions: ArrayF64) -> ArrayF64:
        """Angles from the middle of the arc that was seen."""
        middle = (seen[0] + seen[-1])[[0, 2]]
        across = middle[0] * positions[:, 2] - middle[1] * positions[:, 0]
        return np.asarray(np.arctan2(across, positions[:, [0, 2]] @ middle))

    angles = from_middle(centres(poses))
    # With 240 poses, the ends miss at most a share of (pi / 240)^2 / 2 of half the arc.
    np.testing.assert_allclose([angles.min(), angles.max()], [-np.pi / 3, np.pi / 3], atol=1e-3)
    assert np.abs(np.diff(angles, append=angles[0])).max() < 1.1 * 2 * np.pi / 240 * np.pi / 3


def test_a_turntable_of_cameras_straight_above() -> None:
    target = np.array([0.5, 0.0, 2.0])
    above = [target + np.array([x, -3.0, z]) for x, z in ((-0.3, 0), (0.3, 0), (0, 0.3))]
    ahead = np.array([0.0, 0, 1])
    poses = turntable([camera(look_at(position, target, ahead)) for position in above], 10)
    assert np.isfinite(poses).all()
    np.testing.assert_allclose(np.linalg.det(poses[:, :3, :3]), 1.0)


def test_parallel_axes_have_no_centre() -> None:
    poses = np.tile(np.eye(4), (5, 1, 1))
    poses[:, 0, 3] = np.arange(5)
    with pytest.raises(InputError, match="look in the same direction"):
        turntable([camera(pose) for pose in poses], 10)


@pytest.mark.parametrize("size", [(48, 27), (192, 54), (96, 200), (95, 53)])
def test_another_size_shows_no_less_without_distortion(size: tuple[int, int]) -> None:
    pose = camera(np.eye(4))
    other = framed(pose, *size)
    assert (other.width, other.height) == size and other.fx == pytest.approx(other.fy)

    def seen(each: Camera) -> list[float]:
        """Left, right, top and bottom edge, as slopes of rays."""
        across = [-each.cx / each.fx, (each.width - each.cx) / each.fx]
        return [*across, -each.cy / each.fy, (each.height - each.cy) / each.fy]

    for before, after in zip(seen(pose), seen(other), strict=True):
        assert abs(after) >= abs(before) - 1e-9
    assert any(before == pytest.approx(after) for before, after in zip(seen(pose), seen(other), strict=True))
