"""Camera paths, computed from the poses of a capture: its smoothed path, and a circle around its subject."""

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
"""Minimum and maximum sigma of the filter along the path, as a share of the path's length. Between them,
sigma is three quarters of the mean distance between frames. This removes shake and corners at frames."""
_SAMPLES = 2000  # minimum number of samples of the path for the filter
_PARALLEL = 0.003
"""Mean squared sine of the angle between the optical axes and their mean (3 degrees), below which the point
where they meet is unreliable."""
_MIN_RADIUS = 0.25
"""Minimum radius of a turntable, as a share of the distance to its centre, for cameras straight above it."""
WIDEST_GAP = np.pi / 2
"""Maximum angle between neighbouring cameras around the axis for a full turn; see `turntable`."""
_UP_WEIGHT = 0.003
"""Weight of the cameras' mean up vector in `up_axis`, compared with the constraint by horizontal axes."""


def smooth_path(
    cameras: Sequence[Camera], count: int
) -> tuple[ArrayF64, NDArray[np.int64]]:  # [K, 4, 4] world to camera, [K]
    """Smooth the path of ``cameras`` (in the order of their frames), and return ``count`` poses along it.

    The length of a step is the distance, relative to the extent of the path, plus the angle divided by pi, so
    that a rotation without translation takes time too. Positions and quaternions are filtered with a Gaussian
    along the path. The padding mirrors the path through its ends, so that the ends do not move.

    The second result is the index of the nearest camera. Raises InputError if the cameras do not move.
    """
    centres = np.stack([camera.centre for camera in cameras])
    quaternions = Rotation.from_matrix([camera.world_to_camera[:3, :3].T for camera in cameras]).as_quat()
    jumps = np.sum(quaternions[1:] * quaternions[:-1], axis=1) < 0  # q and -q are the same rotation
    quaternions[1:] *= np.where(np.cumsum(jumps) % 2, -1.0, 1.0)[:, None]
    path = np.hstack([centres, quaternions])
    motion = _motion(path)
    moved = np.concatenate([[True], np.diff(motion) > 1e-9])  # repeated poses are left out
    if moved.sum() < 2:
        raise InputError(
            "the cameras of this capture do not move, so there is no path to follow",
            hint="render one of its frames with --frame, or give --poses",
        )
    numbers, motion = np.flatnonzero(moved), motion[moved]
    samples = np.linspace(0, motion[-1], max(_SAMPLES, 20 * len(cameras)))
    sigma = len(samples) * np.clip(0.75 / (len(numbers) - 1), *_SMOOTHING)
    border = int(4 * sigma) + 1
    path = _at(samples, motion, path[moved])
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
    """Return ``count`` poses on a circle around the point that ``cameras`` look at.

    The axis is `up_axis`. Radius and height are the medians over the cameras. The path starts near the first
    camera and makes a full turn. If a gap between the cameras exceeds `WIDEST_GAP`, it goes back and forth
    over the rest of the circle instead. Raises InputError if all cameras look in the same direction.
    """
    centre = seen_point(cameras)
    up = up_axis(cameras)
    offsets = np.stack([camera.centre for camera in cameras]) - centre
    heights = offsets @ up
    away = offsets - heights[:, None] * up
    radii = np.linalg.norm(away, axis=1)
    distance = float(np.median(np.linalg.norm(offsets, axis=1)))
    radius = max(float(np.median(radii)), _MIN_RADIUS * distance)
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
        first = min(0.0, -2 * np.pi, key=lambda angle: abs(angle - middle))  # the first camera
        begin = np.arcsin(np.clip((first - middle) / max(half, 1e-9), -1.0, 1.0))
        angles = middle + half * np.sin(begin + phases)
    around = np.cos(angles)[:, None] * ahead + np.sin(angles)[:, None] * aside
    positions = centre + radius * around + np.median(heights) * up
    return np.stack([look_at(position, centre, up) for position in positions])


def seen_point(cameras: Sequence[Camera]) -> ArrayF64:  # [3]
    """Return the point nearest to all optical axes (least squares). Raises InputError for parallel axes."""
    axes = np.stack([camera.world_to_camera[2, :3] for camera in cameras])
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]  # [N, 3, 3] projections along each axis
    total = across.mean(axis=0)
    if np.linalg.eigvalsh(total)[0] < _PARALLEL:
        raise InputError(
            "the cameras of this capture look in the same direction, so a turntable has no centre",
            hint="leave out --turntable to follow their path",
        )
    centres = np.stack([camera.centre for camera in cameras])
    return np.asarray(np.linalg.solve(total, np.einsum("nij,nj->i", across, centres) / len(cameras)))


def up_axis(cameras: Sequence[Camera]) -> ArrayF64:  # [3] unit
    """Return the direction that is most perpendicular to the cameras' horizontal axes (as in nerfstudio).

    The mean of the cameras' up vectors would be tilted if they look down from one side. If all horizontal
    axes are equal, the direction is ambiguous: a small weight of that mean decides.
    """
    rights = np.stack([camera.world_to_camera[0, :3] for camera in cameras])
    mean = _unit(-np.mean([camera.world_to_camera[1, :3] for camera in cameras], axis=0))
    level = rights.T @ rights / len(rights) - _UP_WEIGHT * np.outer(mean, mean)
    up: ArrayF64 = np.linalg.eigh(level)[1][:, 0]
    return up if up @ mean > 0 else -up


def framed(camera: Camera, width: int, height: int) -> Camera:
    """Return ``camera`` with another image size in pixels, without distortion.

    It shows everything that ``camera`` shows. If the aspect ratio differs, it shows more on two sides.
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
    """Return the accumulated step length of `smooth_path` at each centre and quaternion."""
    centres, turns = path[:, :3], Rotation.from_quat(path[:, 3:])
    distance = np.linalg.norm(np.diff(centres, axis=0), axis=1)
    extent = float(np.linalg.norm(np.ptp(centres, axis=0)))
    angle = (turns[:-1].inv() * turns[1:]).magnitude()
    return np.concatenate([[0.0], np.cumsum(distance / max(extent, 1e-12) + angle / np.pi)])


def _at(samples: ArrayF64, motion: ArrayF64, path: ArrayF64) -> ArrayF64:
    """Interpolate ``path`` [N, C], which is known at ``motion`` [N], at ``samples`` [K]."""
    return np.stack([np.interp(samples, motion, column) for column in path.T], axis=1)


def _unit(vector: ArrayF64) -> ArrayF64:
    return np.asarray(vector / max(float(np.linalg.norm(vector)), 1e-12))
