"""Cameras and poses, in COLMAP's conventions.

Distortion is pycolmap's (all COLMAP models). Only its camera mathematics is called in this process, on
parameters that were checked: COLMAP's failed checks would end the process.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cleargs.errors import InputError
from cleargs.media import MAX_PIXELS

if TYPE_CHECKING:
    from cleargs.capture.colmap import pycolmap

SINGLE_FOCAL = frozenset(
    {"SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE"}
)
"""Models with one focal length: f, cx, cy, ..."""

TWO_FOCALS = frozenset({"PINHOLE", "OPENCV", "OPENCV_FISHEYE", "FULL_OPENCV", "THIN_PRISM_FISHEYE", "FOV"})
"""Models with two: fx, fy, cx, cy, ..."""

MAX_PARAMETER, MIN_FOCAL = 1e9, 1e-3
"""Largest size of a camera's numbers, and shortest focal length, px: beyond them pixels and rays overflow."""


@dataclass(frozen=True)
class Camera:
    """Intrinsics in pixels of an image of ``width`` x ``height``; the centre of the first pixel is 0.5."""

    model: str
    width: int
    height: int
    params: tuple[float, ...]

    def __post_init__(self) -> None:
        if self.model not in SINGLE_FOCAL | TWO_FOCALS:
            raise InputError(
                f"camera model {self.model} is not supported",
                hint="undistort the images first, or use a perspective or OpenCV fisheye model",
            )
        if not np.isfinite(self.params).all() or np.abs(self.params).max(initial=0.0) > MAX_PARAMETER:
            raise InputError(
                "a camera has parameters that are not finite, or that no lens has",
                hint="correct the camera in the input",
            )
        if min(self.width, self.height) < 1:
            raise InputError("a camera has images without pixels", hint="correct the camera in the input")
        if self.width * self.height > MAX_PIXELS:
            raise InputError(
                f"a camera has more than {MAX_PIXELS} pixels",
                hint="correct the camera in the input, or reduce its images",
            )
        if not self.colmap().verify_params() or min(self.focal) < MIN_FOCAL:
            raise InputError(
                f"a {self.model} camera has a wrong number of parameters or a focal length of 0 or less",
                hint="correct the camera in the input",
            )

    @property
    def focal(self) -> tuple[float, float]:
        """fx, fy."""
        return (self.params[0],) * 2 if self.model in SINGLE_FOCAL else (self.params[0], self.params[1])

    @property
    def centre(self) -> tuple[float, float]:
        """cx, cy."""
        start = 1 if self.model in SINGLE_FOCAL else 2
        return self.params[start], self.params[start + 1]

    @property
    def is_pinhole(self) -> bool:
        """Whether the image needs no undistortion."""
        distortion = self.params[3:] if self.model in SINGLE_FOCAL else self.params[4:]
        return not any(distortion) and not self.model.endswith("FISHEYE") and self.model != "FOV"

    def resized(self, width: int, height: int) -> Camera:
        """The camera of the same picture scaled to another size."""
        if (width, height) == (self.width, self.height):
            return self
        camera = self.colmap()
        camera.rescale(width, height)
        return Camera(self.model, width, height, tuple(camera.params.tolist()))

    def colmap(self) -> pycolmap.Camera:
        """As pycolmap has it (loaded when it is first needed: every run looks up its inputs)."""
        from cleargs.capture.colmap import pycolmap

        return pycolmap.Camera(
            model=self.model, width=self.width, height=self.height, params=list(self.params)
        )


def pinhole(width: int, height: int, fx: float, fy: float, cx: float, cy: float) -> Camera:
    return Camera("PINHOLE", width, height, (fx, fy, cx, cy))


def guessed_camera(model: str, width: int, height: int) -> Camera:
    """COLMAP's first guess for a frame that has no camera: focal length 1.2 long sides, no distortion."""
    from cleargs.capture.colmap import pycolmap

    focal = 1.2 * max(width, height)
    guess = pycolmap.Camera.create_from_model_name(1, model, focal, width, height)
    return Camera(model, width, height, tuple(guess.params.tolist()))


@dataclass(frozen=True)
class Pose:
    """World to camera: x_camera = rotation x_world + translation; x right, y down, z forward (OpenCV)."""

    rotation: NDArray[np.float64]  # [3, 3]
    translation: NDArray[np.float64]  # [3]

    @property
    def centre(self) -> NDArray[np.float64]:
        """Camera centre in the world, [3]."""
        centre: NDArray[np.float64] = -self.rotation.T @ self.translation
        return centre

    @property
    def quaternion(self) -> tuple[float, float, float, float]:
        """w, x, y, z with w >= 0."""
        x, y, z, w = Rotation.from_matrix(self.rotation).as_quat(canonical=True)
        return float(w), float(x), float(y), float(z)

    @staticmethod
    def from_quaternion(wxyz: NDArray[np.float64], translation: NDArray[np.float64]) -> Pose:
        w, x, y, z = wxyz
        return Pose(Rotation.from_quat([x, y, z, w]).as_matrix(), np.asarray(translation, np.float64))

    @staticmethod
    def from_opengl(camera_to_world: NDArray[np.float64]) -> Pose:  # [4, 4]
        """From a camera-to-world matrix with OpenGL axes (x right, y up, z back), as in transforms.json."""
        rotation = (camera_to_world[:3, :3] @ np.diag([1.0, -1.0, -1.0])).T
        return Pose(rotation, -rotation @ camera_to_world[:3, 3])
