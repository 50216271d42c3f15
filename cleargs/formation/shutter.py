"""Detection of a rolling shutter in a capture, and the skew that all its frames have in common.

A scene can absorb a skew that all frames share: a walk around a table with a rolling shutter looks like one
with a global shutter around a table that is twisted about its axis. The poses distinguish the two. The
readout takes the same time in every frame, so a frame's skew is that time multiplied by the speed of the
camera at the frame, plus the hand's tremor. Skew and speed vary from frame to frame. The slope of the skew
over the speed is the readout time. The mean skew is the readout time multiplied by the mean speed.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from statistics import median

import numpy as np
from scipy.interpolate import CubicSpline

from cleargs.formation.frame import FrameFormation
from cleargs.formation.motion import Model, grid_basis
from cleargs.splat.camera import Camera
from cleargs.splat.views import TrainingView
from cleargs.types import ArrayF64

ROLLING = 0.015
"""Share of the residual that a rolling shutter must explain in addition to all else, in half of a capture's
frames. Source: measurements in docs/formation.md."""
MIN_TESTED_FRAMES, MAX_TESTED_FRAMES = 4, 16
"""Fewest and most frames that are tested for a rolling shutter. Between the two, half of the capture's frames
are tested."""
MIN_TIMED_FRAMES, UNEVEN = 8, 2.0
"""Fewest frames with a speed from which the readout time is estimated. A frame has a speed if the gaps around
it differ from the median gap by at most this factor: in a short gap, a pose error has more effect."""
MIN_CORRELATION = 0.4
"""Least correlation of skews and speeds from which the slope gives the readout time. Source: measurements in
docs/experiments/formation.md."""
WITH_SKEW: dict[Model, Model] = {"none": "skew", "blur": "both", "skew": "skew", "both": "both"}
"""Model of a frame to which a skew is added. A defocused frame keeps its model."""


def rolls(frames: Iterable[FrameFormation]) -> bool:
    """Return True if the capture's shutter rolls, by the skews of all frames together.

    A camera's shutter rolls in every frame or in none. A single skew can also absorb an error of one frame's
    pose or geometry.
    """
    gains = [frame.skew_gain for frame in frames if frame.skew_gain is not None]
    return len(gains) >= MIN_TESTED_FRAMES and median(gains) > ROLLING


def frames_to_test(count: int) -> list[int]:
    """Return the indices, evenly spread, of the frames that are tested for a rolling shutter."""
    tested = min(count, max(MIN_TESTED_FRAMES, min(MAX_TESTED_FRAMES, count // 2)))
    return [(2 * k + 1) * count // (2 * tested) for k in range(tested)]


@dataclass(frozen=True)
class CameraSpeeds:
    """The motion of the scene past the camera, in the frames of a capture."""

    per_frame: Mapping[int, ArrayF64]
    """Twist [6] per unit of time, by frame_id: translation in world units and rotation in radians, both times
    the focal length in px. It is that of a cubic spline through the poses."""
    metric: ArrayF64  # [6, 6]
    """Matrix M: the mean squared image motion of a twist v in px over the image is vᵀ M v, px^2."""
    interval: float
    """Median time between frames. No readout takes longer."""

    @classmethod
    def of(cls, views: Sequence[TrainingView]) -> CameraSpeeds | None:
        """Return the speeds in ``views``; None if there are too few views or their times do not increase."""
        times = np.array([view.time for view in views], np.float64)
        gaps = np.diff(times)
        if len(views) < MIN_TIMED_FRAMES + 2 or not (gaps > 0.0).all():
            return None
        poses = np.stack([view.camera.world_to_camera for view in views])
        rates = CubicSpline(times, poses)(times, 1) @ np.linalg.inv(poses)
        turns = 0.5 * (rates - rates.transpose(0, 2, 1))
        focal = np.array([view.camera.fx for view in views])
        twists = np.column_stack([rates[:, :3, 3], turns[:, 2, 1], turns[:, 0, 2], turns[:, 1, 0]])
        interval = float(np.median(gaps))
        even = np.abs(np.log(gaps / interval)) <= math.log(UNEVEN)
        inner = zip(views[1:-1], focal[1:-1], twists[1:-1], even[:-1] & even[1:], strict=True)
        per_frame = {view.frame_id: scale * twist for view, scale, twist, timed in inner if timed}
        return cls(per_frame, _image_motion(views[0].camera), interval)

    def missing_skew(self, frames: Mapping[int, FrameFormation]) -> ArrayF64 | None:
        """Return the skew that all ``frames`` lack in common, a twist [6] as in `per_frame`.

        None if there are too few frames, skews and speeds do not correlate, or the readout is too long.
        """
        ids = [k for k in self.per_frame if frames[k].model in WITH_SKEW]
        if len(ids) < MIN_TIMED_FRAMES:
            return None
        scales = np.stack([_scale(frames[k].motion.median_depth) for k in ids])
        skews = np.stack([frames[k].motion.skew for k in ids])
        speeds = np.stack([self.per_frame[k] for k in ids]) / scales
        varying, faster = skews - skews.mean(axis=0), speeds - speeds.mean(axis=0)
        common, spread = self._product(varying, faster), self._product(faster, faster)
        if common <= MIN_CORRELATION * math.sqrt(self._product(varying, varying) * spread):
            return None
        readout = common / spread
        if readout > self.interval:
            return None
        missing: ArrayF64 = ((readout * speeds - skews) * scales).mean(axis=0)
        return missing

    def _product(self, a: ArrayF64, b: ArrayF64) -> float:  # [N, 6] px
        return float(np.einsum("ni,ij,nj->", a, self.metric, b))


def with_skew(frame: FrameFormation, twist: ArrayF64) -> FrameFormation:
    """Return a frame with a further skew, a twist [6] as in `CameraSpeeds.per_frame`."""
    if frame.model not in WITH_SKEW:
        return frame
    added = twist / _scale(frame.motion.median_depth)
    motion = replace(frame.motion, skew=frame.motion.skew + added)
    displacement = frame.displacement_px + 0.5 * float(np.abs(added).sum())
    return replace(frame, model=WITH_SKEW[frame.model], motion=motion, displacement_px=displacement)


def _scale(median_depth: float) -> ArrayF64:  # [6]
    """Return the factors from a frame's twist in px to world units and radians times the focal length."""
    return np.array([median_depth] * 3 + [1.0] * 3)


def _image_motion(camera: Camera) -> ArrayF64:  # [6, 6]
    """Return the matrix of the mean squared image motion of a twist at the median depth, px."""
    basis = grid_basis(camera, (9, 16))
    return np.asarray(np.einsum("icyx,jcyx->ij", basis, basis) / basis[0, 0].size)
