"""A handheld walk around the room: smooth drift, pauses and swings, and the tremor of a hand (1-12 Hz)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

UP = np.array([0.0, 1.0, 0.0])
TREMOR_HZ = (1.0, 12.0)
TREMOR_RADIANS = 0.004
"""Deviation of the aim, about a quarter of a degree, as of a hand that tries to hold still."""


@dataclass(frozen=True)
class HandheldPath:
    """A camera path around ``focus``; poses are camera to world [3, 4] with OpenCV axes."""

    focus: NDArray[np.float64]  # [3] metres
    arc: float
    """Angle walked around the focus, radians."""
    duration: float
    """Seconds."""
    phases: NDArray[np.float64]  # [3 axes, harmonics]
    frequencies: NDArray[np.float64]  # [3 axes, harmonics] Hz
    swing: NDArray[np.float64]  # [2] phases of height and distance

    def pose(self, time: float) -> NDArray[np.float64]:
        """Where the camera is at ``time`` seconds."""
        share = time / self.duration
        # The walk speeds up and slows down: its speed is 1 + 0.8 cos, so that frames bunch at the pauses.
        progress = share + 0.8 / (6 * np.pi) * np.sin(6 * np.pi * share)
        angle = (progress - 0.5) * self.arc
        distance = 2.15 + 0.2 * np.sin(2 * np.pi * share + self.swing[0])
        height = 1.4 + 0.18 * np.sin(4 * np.pi * share + self.swing[1])
        centre = self.focus + np.array([distance * np.sin(angle), 0, distance * np.cos(angle)])
        centre[1] = height
        tremor = np.sin(2 * np.pi * self.frequencies * time + self.phases).mean(1) * np.sqrt(2)
        aim = Rotation.from_rotvec(TREMOR_RADIANS * np.sqrt(self.phases.shape[1]) * tremor)
        return look_at(centre, self.focus) @ _homogeneous(aim.as_matrix())


def _homogeneous(rotation: NDArray[np.float64]) -> NDArray[np.float64]:
    matrix = np.eye(4)
    matrix[:3, :3] = rotation
    return matrix


def look_at(centre: NDArray[np.float64], target: NDArray[np.float64]) -> NDArray[np.float64]:
    """Camera-to-world pose [3, 4] (OpenCV axes) at ``centre`` that looks at ``target``, level."""
    forward = target - centre
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, UP)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(forward, right), forward, centre], 1)


def make_path(focus: NDArray[np.float64], frames: int, seed: int) -> HandheldPath:
    """A path on which ``frames`` neighbours are about 4 degrees apart, over at most 150 degrees."""
    rng = np.random.default_rng([seed, 12])
    arc = np.radians(min(4.0 * frames, 150.0))
    frequencies = np.geomspace(*TREMOR_HZ, 12) * rng.uniform(0.9, 1.1, (3, 12))
    phases = rng.uniform(0, 2 * np.pi, (3, 12))
    return HandheldPath(focus, float(arc), frames / 4, phases, frequencies, rng.uniform(0, 2 * np.pi, 2))


def exposure_poses(
    middle: NDArray[np.float64],  # [3, 4]
    instants: NDArray[np.float64],  # [S] in -0.5 ... 0.5 of the exposure
    sweep: float,
    rng: np.random.Generator,
) -> NDArray[np.float64]:  # [S, 3, 4]
    """Poses within one exposure: the aim sweeps ``sweep`` radians along a slightly bent path, and drifts.

    The pose at the middle of the exposure is ``middle``.
    """
    direction = rng.uniform(0, 2 * np.pi)
    along = np.array([np.sin(direction), np.cos(direction), rng.normal(0, 0.15)])
    across = np.array([np.cos(direction), -np.sin(direction), 0.0]) * rng.normal(0, 0.35)
    drift = rng.normal(0, 0.25, 3) * sweep
    poses = np.empty((len(instants), 3, 4))
    for number, instant in enumerate(instants):
        turn = Rotation.from_rotvec(sweep * (along * instant + across * instant**2)).as_matrix()
        poses[number] = middle @ _homogeneous(turn)
        poses[number, :, 3] += middle[:, :3] @ (drift * instant)
    return poses
