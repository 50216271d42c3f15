"""Smooth courses for a walk: around the room's table, or along the cameras of a real capture.

Poses are camera to world with OpenCV axes. A course is walked from share 0 to 1.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.interpolate import BSpline, make_smoothing_spline

from cleargs.errors import InputError
from cleargs.random_streams import Stream
from cleargs.synth.optics import Array

UP = np.array([0.0, 1.0, 0.0])
DEGREES_A_FRAME, MAX_DEGREES = 4.0, 150.0
SMOOTHING = 0.5
"""Weight of the curvature of a spline through cameras, which are one apart."""
MIN_CAMERAS = 5


class Course(Protocol):
    """The drift of a walk, without pauses or tremor."""

    def poses(self, shares: Array) -> Array:
        """Poses [T, 3, 4] at ``shares`` [T] of the way; a little beyond 0 and 1 is allowed."""
        ...

    def novel(self, share: float, rng: np.random.Generator) -> Array:
        """A pose [3, 4] off the course, near ``share``, that looks at what the course looks at."""
        ...


def look_at(centres: Array, target: Array) -> Array:  # [..., 3], [3]
    """Poses [..., 3, 4] at ``centres`` that look at ``target``, level in a world with y up."""
    forward = target - centres
    forward = forward / np.linalg.norm(forward, axis=-1, keepdims=True)
    right = np.cross(forward, UP)
    right /= np.linalg.norm(right, axis=-1, keepdims=True)
    return np.stack([right, np.cross(forward, right), forward, centres], -1)


@dataclass(frozen=True)
class Orbit:
    """An arc around ``focus`` at changing height and distance, in metres."""

    focus: Array  # [3]
    arc: float
    """Radians."""
    phases: Array  # [2] of distance and height

    def poses(self, shares: Array) -> Array:
        return look_at(self._centres(shares), self.focus)

    def novel(self, share: float, rng: np.random.Generator) -> Array:
        """Nearer or farther, higher or lower: off by up to one and a half frames' way in each axis."""
        centre = self._centres(np.array([share]))[0] + rng.uniform(-0.22, 0.22, 3)
        return look_at(centre, self.focus + rng.uniform(-0.08, 0.08, 3))

    def _centres(self, shares: Array) -> Array:
        angle = (shares - 0.5) * self.arc
        distance = 2.15 + 0.2 * np.sin(2 * np.pi * shares + self.phases[0])
        height = 1.4 + 0.18 * np.sin(4 * np.pi * shares + self.phases[1])
        east, south = self.focus[0] + distance * np.sin(angle), self.focus[2] + distance * np.cos(angle)
        return np.stack([east, height, south], 1)


def orbit(focus: Array, frames: int, seed: int) -> Orbit:
    """A course on which ``frames`` neighbours are about 4 degrees apart, over at most 150 degrees."""
    arc = np.radians(min(DEGREES_A_FRAME * frames, MAX_DEGREES))
    return Orbit(focus, float(arc), np.random.default_rng([seed, Stream.ORBIT]).uniform(0, 2 * np.pi, 2))


@dataclass(frozen=True)
class CameraCourse:
    """A smoothing spline through real cameras in the order in which they were taken."""

    spline: BSpline
    """Number of a camera of the course -> the 12 numbers of a pose, its rotation not yet orthonormal."""
    steps: float
    """Number of the last camera."""
    spacing: float
    """Median distance of neighbouring cameras of the course, world units."""

    def poses(self, shares: Array) -> Array:
        raw = np.asarray(self.spline(shares * self.steps), np.float64).reshape(-1, 3, 4)
        u, _, vt = np.linalg.svd(raw[:, :, :3])
        return np.concatenate([u @ vt, raw[:, :, 3:]], 2)

    def novel(self, share: float, rng: np.random.Generator) -> Array:
        """Off by up to one and a half spacings in each of the camera's axes."""
        pose: Array = self.poses(np.array([share]))[0]
        pose[:, 3] += pose[:, :3] @ rng.uniform(-1.5, 1.5, 3) * self.spacing
        return pose


def camera_course(cameras: Sequence[Array], frames: int) -> CameraCourse:
    """The course along ``frames`` consecutive ``cameras`` [3, 4] whose longest step is the shortest.

    So that neighbours overlap as in the real capture, and the walk never crosses a gap that another stretch
    avoids. Raises InputError when there are fewer cameras than frames, fewer than `MIN_CAMERAS`, or all at
    one place.
    """
    poses = np.stack(cameras) if cameras else np.empty((0, 3, 4))
    if len(poses) < max(frames, MIN_CAMERAS):
        raise InputError(
            f"{frames} frames cannot follow {len(poses)} cameras",
            hint=f"give --frames at most the number of cameras, and at least {MIN_CAMERAS} cameras",
        )
    used = max(frames, MIN_CAMERAS)
    steps = np.linalg.norm(np.diff(poses[:, :, 3], axis=0), axis=1)
    windows = np.lib.stride_tricks.sliding_window_view(steps, used - 1)
    start = int(np.argmin(windows.max(1)))
    spacing = float(np.median(windows[start]))
    if spacing <= 0:
        raise InputError(
            "the cameras stand at one place",
            hint="give cameras that move, as those of a walk through the scene",
        )
    stretch = poses[start : start + used].reshape(used, 12)
    spline = make_smoothing_spline(np.arange(used), stretch, lam=SMOOTHING)
    return CameraCourse(spline, float(frames - 1), spacing)
