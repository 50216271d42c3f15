"""Poses as input files print them, made rigid, and the normalised world: origin at the mean camera centre,
farthest camera at distance 1, mean up along -y."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cleargs.capture.cameras import Pose
from cleargs.errors import InputError

_FLIP = np.diag([1.0, -1.0, -1.0])

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


@dataclass(frozen=True)
class Similarity:
    """x_normalised = rotation (x_input - origin) / scale, all in float64."""

    rotation: NDArray[np.float64]  # [3, 3]
    origin: NDArray[np.float64]  # [3]
    scale: float

    def points(self, xyz: NDArray[np.float64]) -> NDArray[np.float64]:  # [N, 3]
        """Points of the input's world in the normalised one."""
        moved: NDArray[np.float64] = (xyz - self.origin) @ self.rotation.T / self.scale
        return moved

    def pose(self, pose: Pose) -> Pose:
        """The same camera, world to camera, in the normalised world."""
        rotation = pose.rotation @ self.rotation.T
        # From the centre, not from the translation: at world offsets of 1e6 the difference of two large
        # numbers has to be taken once, between centre and origin.
        return Pose(rotation, -rotation @ self.points(pose.centre[None])[0])

    def to_json(self) -> dict[str, Any]:
        """The way back to the input's world, for ``manifest.json``."""
        return {
            "definition": "x_input = scale * rotation @ x_normalised + translation",
            "scale": self.scale,
            "rotation": self.rotation.T.tolist(),
            "translation": self.origin.tolist(),
        }

    @staticmethod
    def from_json(noted: Any, ingest: Path) -> Similarity:
        """What `to_json` noted, as the manifest of the finished folder ``ingest`` holds it.

        Raises InputError when it does not.
        """
        try:
            return Similarity(
                np.array(noted["rotation"], np.float64).T,
                np.array(noted["translation"], np.float64),
                float(noted["scale"]),
            )
        except (KeyError, TypeError, ValueError) as error:
            raise InputError(
                f"{ingest} does not say how it was normalised", hint="run that stage with --force"
            ) from error


def normalise(poses: Sequence[Pose]) -> Similarity:
    """The similarity that normalises the world of these cameras.

    Raises InputError when all of them stand at one place.
    """
    centres = np.stack([pose.centre for pose in poses])
    origin = centres[0] + (centres - centres[0]).mean(axis=0)
    scale = float(np.linalg.norm(centres - origin, axis=1).max())
    if scale <= 1e-9 * max(1e-300, float(np.abs(centres).max())):
        raise InputError(
            "all cameras stand at the same place: there is nothing to triangulate",
            hint="the camera must move, not only turn; check the poses, or set ingest.poses=sfm",
        )
    up = -np.stack([pose.rotation[1] for pose in poses]).mean(axis=0)
    return Similarity(_upright(up), origin, scale)


def _upright(up: NDArray[np.float64]) -> NDArray[np.float64]:
    """The smallest rotation that takes ``up`` to -y; from nearly +y, the smallest after half a turn about x
    (there the smallest rotation's axis hangs on rounding errors)."""
    length = float(np.linalg.norm(up))
    if length < 1e-6:
        return np.eye(3)
    before = _FLIP if up[1] > 0.5 * length else np.eye(3)
    direction = before @ up / length
    target = np.array([0.0, -1.0, 0.0])
    axis = np.cross(direction, target)
    sine = float(np.linalg.norm(axis))
    angle = float(np.arctan2(sine, direction @ target))
    turn = Rotation.from_rotvec(axis / sine * angle).as_matrix() if sine > 0 else np.eye(3)
    rotation: NDArray[np.float64] = turn @ before
    return rotation
