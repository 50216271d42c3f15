"""A pinhole camera in COLMAP's conventions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from cleargs.errors import InputError
from cleargs.types import ArrayF64


@dataclass(frozen=True, eq=False)
class Readout:
    """Motion of the scene past a camera while its rows are read one after the other.

    At place s of the readout, from -1/2 to 1/2, the twist is ``twists[0] + s twists[1] + s² twists[2]``:
    translation, then rotation vector, in the axes of the camera at the middle of the readout.
    """

    twists: npt.NDArray[np.float64]  # [3, 6] world units and radians
    slope: float
    start: float
    """A pixel is read at the place slope * y/z + start, or at slope * x/z + start with ``columns``."""
    columns: bool = False
    """True if columns are read one after the other."""

    def numbers(self) -> list[float]:
        """Return all of it, to compare readouts."""
        return [*self.twists.ravel().tolist(), self.slope, self.start, float(self.columns)]


@dataclass(frozen=True, eq=False)
class Camera:
    """An undistorted pinhole camera.

    Sizes, focal lengths and the principal point are in pixels; pixel centres are at + 0.5.
    ``world_to_camera`` is a rigid [4, 4] float64 matrix with OpenCV axes (x right, y down, z forward).

    Raises:
        InputError: A size or focal length is not positive, or a number is not finite.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    world_to_camera: npt.NDArray[np.float64]  # [4, 4]
    readout: Readout | None = None
    """Rolling shutter of the camera; None: all rows are exposed at once."""

    def __post_init__(self) -> None:
        pose = np.ascontiguousarray(self.world_to_camera, dtype=np.float64)
        object.__setattr__(self, "world_to_camera", pose)
        if pose.shape != (4, 4):
            raise InputError(f"world_to_camera has the shape {pose.shape}", hint="give a [4, 4] rigid matrix")
        numbers = (self.fx, self.fy, self.cx, self.cy)
        positive = min(self.width, self.height, self.fx, self.fy) > 0
        if not (positive and np.isfinite(numbers).all() and np.isfinite(pose).all()):
            raise InputError(
                f"the camera is not usable: {self.width}x{self.height}, fx fy cx cy = {numbers}",
                hint="give positive sizes and focal lengths, in pixels, and finite numbers",
            )

    @property
    def centre(self) -> npt.NDArray[np.float64]:
        """Position of the camera in the world, [3]."""
        rotation, translation = self.world_to_camera[:3, :3], self.world_to_camera[:3, 3]
        centre: npt.NDArray[np.float64] = -rotation.T @ translation
        return centre

    def resized(self, width: int, height: int) -> Camera:
        """Return this camera for images resampled to ``width`` x ``height`` pixels."""
        x, y = width / self.width, height / self.height
        return replace(
            self, width=width, height=height, fx=self.fx * x, fy=self.fy * y, cx=self.cx * x, cy=self.cy * y
        )

    def scaled(self, factor: float) -> Camera:
        """Return this camera for images resampled by ``factor``, its sides rounded to pixels (at least 1)."""
        return self.resized(max(1, round(self.width * factor)), max(1, round(self.height * factor)))


def look_at(position: ArrayF64, target: ArrayF64, up: ArrayF64) -> ArrayF64:  # [4, 4] world to camera
    """Return the pose of a camera at ``position``, without roll (OpenCV axes).

    ``target`` is a point on the optical axis, ``up`` the direction that is up in the image.
    """
    forward = (target - position) / np.linalg.norm(target - position)
    right = np.cross(forward, up)
    right /= max(float(np.linalg.norm(right)), 1e-12)
    pose = np.eye(4)
    pose[:3, :3] = [right, np.cross(forward, right), forward]
    pose[:3, 3] = -pose[:3, :3] @ position
    return pose


def cameras_json(
    cameras: Sequence[tuple[str, Camera]],
    *,
    scale: float = 1.0,
    rotation: npt.NDArray[np.float64] | None = None,  # [3, 3]
    translation: npt.NDArray[np.float64] | None = None,  # [3]
) -> list[dict[str, Any]]:
    """Return the content of ``cameras.json`` of the Inria code, which viewers read next to a PLY.

    ``cameras`` are names and cameras. The similarity x -> scale rotation x + translation is applied to them.
    Each gets one entry, with its centre and its rotation from camera to world.
    """
    turn = np.eye(3) if rotation is None else rotation
    shift = np.zeros(3) if translation is None else translation
    return [
        {
            "id": index,
            "img_name": name,
            "width": camera.width,
            "height": camera.height,
            "position": (scale * turn @ camera.centre + shift).tolist(),
            "rotation": (turn @ camera.world_to_camera[:3, :3].T).tolist(),
            "fy": camera.fy,
            "fx": camera.fx,
        }
        for index, (name, camera) in enumerate(cameras)
    ]
