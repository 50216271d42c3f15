"""Poses as input files print them, made rigid."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cleargs.capture.cameras import Pose
from cleargs.errors import InputError

MAX_COORDINATE = 1e100
"""Of a pose as given, in its own units: distances beyond it overflow when they are squared."""


def within_reach(numbers: NDArray[np.float64]) -> bool:
    """Whether all are finite and no larger than `MAX_COORDINATE`."""
    return bool(np.isfinite(numbers).all() and np.abs(numbers).max(initial=0.0) <= MAX_COORDINATE)


def rigid_pose(camera_to_world: NDArray[np.float64], name: str, hint: str) -> Pose:  # [3 or 4, 4]
    """The pose of frame ``name`` from a camera-to-world matrix with OpenGL axes (x right, y up, z back).

    Printed poses are orthonormal to a few digits only, and some writers leave a scale in: the nearest
    rotation is taken. Raises InputError with ``hint`` for NaN, what is out of reach, a mirror image, or a
    matrix whose axes differ by more than 5 % in length.
    """
    if not within_reach(camera_to_world):
        raise InputError(f"the pose of {name} is not finite, or out of reach", hint=hint)
    u, stretch, vt = np.linalg.svd(camera_to_world[:3, :3])
    if stretch[2] < 1e-9 or stretch[0] > 1.05 * stretch[2] or np.linalg.det(u @ vt) < 0:
        raise InputError(f"the pose of {name} is not a rotation and a translation", hint=hint)
    return Pose.from_opengl(np.column_stack([u @ vt, camera_to_world[:3, 3]]))
