"""Where the camera goes: the capture's path made smooth, and a circle around what the cameras look at.

Pure functions from the poses of a capture to new ones.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from cleargs.errors import InputError
from cleargs.splat.camera import Camera, look_at
from cleargs.types import ArrayF64

_SMOOTHING = (0.025, 0.1)
"""Sigma of the filter along the path, as a share of its length: at least, and at most. Between the two it is
three quarters of the way between two frames. The corners at few frames go, and the tremor of a hand."""
_SAMPLES = 2000
"""Least places at which a path is filtered."""
_PARALLEL = 0.003
"""Mean squared sine of the angle between the optical axes and their mean (3 degrees) below which they do not
meet at a point that could be trusted."""
_FLATTEST = 0.25
"""Smallest radius of a turntable, as a share of the distance to its centre: cameras straight above it give no
circle."""
WIDEST_GAP = np.pi / 2
"""Between neighbouring cameras around the axis, up to which a turntable turns fully."""
_PULL = 0.003
"""Weight of the cameras' mean up, against their horizontal axes, in what is up."""


def smooth_path(
    cameras: Sequence[Camera], count: int
) -> tuple[ArrayF64, NDArray[np.int64]]:  # [K, 4, 4] world to camera, [K]
    """The way of ``cameras`` (in the order of their frames) from the first pose to the last, made smooth and
    cut into ``count`` poses of equal steps.

    A step's length is the distance over the extent of the path plus the angle over pi, so that a camera
    which only turns takes its time as well. Positions and quaternions go through one Gaussian filter along
    the path, mirrored through its ends, which therefore stay where they are.

    Returns the poses, and the number of the camera that is nearest to each along the way.

    Raises InputError when no camera moves.
    """
    centres = np.stack([camera.centre for camera in cameras])
    quaternions = Rotation.from_matrix([camera.world_to_camera[:3, :3].T for camera in cameras]).as_quat()
    jumps = np.sum(quaternions[1:] * quaternions[:-1], axis=1) < 0  # q and -q are the same turn
    quaternions[1:] *= np.where(np.cumsum(jumps) % 2, -1.0, 1.0)[:, None]
    path = np.hstack([centres, quaternions])
    motion = _motion(path)
    kept = np.concatenate([[True], np.diff(motion) > 1e-9])
    if kept.sum() < 2:
        raise InputError(
            "the cameras of this capture do not move: there is no path to follow",
            hint="render one of its frames with --frame, or give --poses",
        )
    numbers, motion = np.flatnonzero(kept), motion[kept]
    samples = np.linspace(0, motion[-1], max(_SAMPLES, 20 * len(cameras)))
    sigma = len(samples) * np.clip(0.75 / (len(numbers) - 1), *_SMOOTHING)
    border = int(4 * sigma) + 1
    path = _at(samples, motion, path[kept])
    path = np.pad(path, ((border, border), (0, 0)), mode="reflect", reflect_type="odd")
    path = gaussian_filter1d(path, sigma, axis=0)[border:-border]
    passed = np.interp(samples, motion, numbers)

    motion = _motion(path)
    even = np.linspace(0, motion[-1], count)
    path = _at(even, motion, path)
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = Rotation.from_quat(path[:, 3:]).inv().as_matrix()
    poses[:, :3, 3] = -np.einsum("kij,kj->ki", poses[:, :3, :3], path[:, :3])
    return poses, np.rint(np.interp(even, motion, passed)).astype(np.int64)


def turntable(cameras: Sequence[Camera], count: int) -> ArrayF64:  # [count, 4, 4] world to camera
    """A turn in ``count`` steps around the point that ``cameras`` look at, from the first one's side.

    At their median distance from the axis and median height; the axis is that of `up_axis`.

    It is a full one in equal steps; where the cameras leave more than `WIDEST_GAP` of it out, it goes to and
    fro along what they saw, since beyond it the scene has nothing to show.

    Raises InputError when they all look the same way.
    """
    centre = seen_point(cameras)
    up = up_axis(cameras)
    offsets = np.stack([camera.centre for camera in cameras]) - centre
    heights = offsets @ up
    away = offsets - heights[:, None] * up
    radii = np.linalg.norm(away, axis=1)
    distance = float(np.median(np.linalg.norm(offsets, axis=1)))
    radius = max(float(np.median(radii)), _FLATTEST * distance)
    ahead = _unit(away[np.argmax(radii > 1e-6 * distance)])
    aside = np.cross(up, ahead)
    phases = 2 * np.pi * np.arange(count) / count
    seen = np.sort(np.arctan2(away @ aside, away @ ahead))
    gaps = np.diff(seen, append=seen[0] + 2 * np.pi)
    widest = int(np.argmax(gaps))
    angles = phases
    if gaps[widest] > WIDEST_GAP:
        half = 0.5 * (2 * np.pi - gaps[widest])
        middle = seen[widest] - half
        first = min(0.0, -2 * np.pi, key=lambda angle: abs(angle - middle))  # where the first camera stands
        begin = np.arcsin(np.clip((first - middle) / max(half, 1e-9), -1.0, 1.0))
        angles = middle + half * np.sin(begin + phases)
    around = np.cos(angles)[:, None] * ahead + np.sin(angles)[:, None] * aside
    places = centre + radius * around + np.median(heights) * up
    return np.stack([look_at(place, centre, up) for place in places])


def seen_point(cameras: Sequence[Camera]) -> ArrayF64:  # [3]
    """The point nearest to all optical axes, by least squares. Raises InputError when they are parallel."""
    axes = np.stack([camera.world_to_camera[2, :3] for camera in cameras])
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]  # [N, 3, 3] projections along each axis
    total = across.mean(axis=0)
    if np.linalg.eigvalsh(total)[0] < _PARALLEL:
        raise InputError(
            "the cameras of this capture all look the same way: there is nothing to circle around",
            hint="follow their path instead: leave out --turntable",
        )
    centres = np.stack([camera.centre for camera in cameras])
    point: ArrayF64 = np.linalg.solve(total, np.einsum("nij,nj->i", across, centres) / len(cameras))
    return point


def up_axis(cameras: Sequence[Camera]) -> ArrayF64:  # [3] unit
    """Up: what the horizontal axes of ``cameras`` are perpendicular to, as nerfstudio finds it.

    The mean of their own ups would lean over, where they look down and stand on one side. Cameras whose
    horizontal axes are all alike leave it open; a small pull towards that mean settles it.
    """
    rights = np.stack([camera.world_to_camera[0, :3] for camera in cameras])
    mean = _unit(-np.mean([camera.world_to_camera[1, :3] for camera in cameras], axis=0))
    level = rights.T @ rights / len(rights) - _PULL * np.outer(mean, mean)
    up: ArrayF64 = np.linalg.eigh(level)[1][:, 0]
    return up if up @ mean > 0 else -up


def framed(camera: Camera, width: int, height: int) -> Camera:
    """``camera`` with a picture of ``width`` x ``height``, not stretched: it shows all that it showed, and
    more on two sides where the shape differs.
    """
    scale = min(width / camera.width, height / camera.height)
    return replace(
        camera,
        width=width,
        height=height,
        fx=scale * camera.fx,
        fy=scale * camera.fy,
        cx=width / 2 + scale * (camera.cx - camera.width / 2),
        cy=height / 2 + scale * (camera.cy - camera.height / 2),
    )


def _motion(path: ArrayF64) -> ArrayF64:  # [N, 7] -> [N], from 0
    """Motion up to each centre and quaternion; see `smooth_path`."""
    centres, turns = path[:, :3], Rotation.from_quat(path[:, 3:])
    distance = np.linalg.norm(np.diff(centres, axis=0), axis=1)
    extent = float(np.linalg.norm(np.ptp(centres, axis=0)))
    angle = (turns[:-1].inv() * turns[1:]).magnitude()
    return np.concatenate([[0.0], np.cumsum(distance / max(extent, 1e-12) + angle / np.pi)])


def _at(places: ArrayF64, motion: ArrayF64, path: ArrayF64) -> ArrayF64:
    """The rows of ``path`` [N, C], given at ``motion`` [N], at ``places`` [K]."""
    return np.stack([np.interp(places, motion, column) for column in path.T], axis=1)


def _unit(vector: ArrayF64) -> ArrayF64:
    unit: ArrayF64 = vector / max(float(np.linalg.norm(vector)), 1e-12)
    return unit
