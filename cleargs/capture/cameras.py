"""Cameras and poses in COLMAP's conventions, and the normalised world.

The normalised world has its origin at the mean camera centre, the farthest camera at distance 1, and the mean
up direction along -y. pycolmap computes distortion. This module calls only the camera functions of pycolmap,
with checked parameters, because a failed check in COLMAP ends the process.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cleargs.capture.camera_models import MODELS
from cleargs.errors import InputError
from cleargs.files import write_json
from cleargs.media import MAX_PIXELS
from cleargs.safe_io import FAULTS, read_json

if TYPE_CHECKING:
    from cleargs.capture.colmap import pycolmap

MAX_ASPECT, MIN_FOCAL, MIN_FISHEYE, MAX_FOCAL = 1.1, 0.3, 0.13, 5.0
"""Largest ratio of fx and fy, least focal length in long sides of a lens and of a fisheye, and largest one of
both, that are believed. 0.13 is a circle of 250 degrees in a picture of 16:9."""

WORLD = "world.json"
"""File of ingest with the similarity from its world to that of the input."""

MAX_PARAMETER, SHORTEST_FOCAL = 1e9, 1e-3
"""Largest camera parameter, and shortest focal length in pixels. Beyond them pixels and rays overflow."""

COLMAPS_GUESS = 1.2
"""Focal length, in long sides, with which COLMAP starts if nothing is known."""

_FLIP = np.diag([1.0, -1.0, -1.0])

MAX_COORDINATE = 1e100
"""Largest coordinate of a given pose, in the input's units. Larger distances overflow when they are
squared."""


@dataclass(frozen=True)
class Intrinsics:
    """Intrinsics in pixels of an image of ``width`` x ``height``. The centre of the first pixel is 0.5.

    Raises InputError for an unknown model, or parameters that no lens has.
    """

    model: str
    width: int
    height: int
    params: tuple[float, ...]

    def __post_init__(self) -> None:
        if self.model not in MODELS:
            raise InputError(
                f"camera model {self.model} is not supported",
                hint="undistort the images first, or use a perspective or OpenCV fisheye model",
            )
        fault = ""
        if not np.isfinite(self.params).all() or np.abs(self.params).max(initial=0.0) > MAX_PARAMETER:
            fault = "a camera has parameters that are not finite, or that no lens has"
        elif min(self.width, self.height) < 1:
            fault = "a camera has images without pixels"
        elif self.width * self.height > MAX_PIXELS:
            fault = f"a camera has more than {MAX_PIXELS} pixels"
        elif not self.colmap().verify_params() or min(self.focal) < SHORTEST_FOCAL:
            fault = f"a {self.model} camera has a wrong number of parameters or a focal length of 0 or less"
        if fault:
            raise InputError(fault, hint="correct the camera in the input")

    @property
    def focal(self) -> tuple[float, float]:
        """Focal lengths fx and fy, px."""
        camera = self.colmap()
        return camera.focal_length_x, camera.focal_length_y

    @property
    def centre(self) -> tuple[float, float]:
        """Principal point cx and cy, px."""
        camera = self.colmap()
        return camera.principal_point_x, camera.principal_point_y

    @property
    def is_fisheye(self) -> bool:
        """Return True for a model that can see 90 degrees and more off its axis."""
        return MODELS[self.model].fisheye

    @property
    def is_pinhole(self) -> bool:
        """Return True if the image needs no undistortion."""
        return not self.is_fisheye and bool(self.colmap().is_undistorted())

    def resized(self, width: int, height: int) -> Intrinsics:
        """Return the camera of the same image scaled to another size."""
        if (width, height) == (self.width, self.height):
            return self
        camera = self.colmap()
        camera.rescale(width, height)
        return Intrinsics(self.model, width, height, tuple(camera.params.tolist()))

    def moved(self, across: float, down: float) -> Intrinsics:
        """Return the camera with its principal point moved, px."""
        camera = self.colmap()
        camera.principal_point_x += across
        camera.principal_point_y += down
        return Intrinsics(self.model, self.width, self.height, tuple(camera.params.tolist()))

    def colmap(self) -> pycolmap.Camera:
        """Return the pycolmap camera. The import is here, so that inputs can be looked up without it."""
        from cleargs.capture.colmap import pycolmap

        return pycolmap.Camera(
            model=self.model, width=self.width, height=self.height, params=list(self.params)
        )


def pinhole(width: int, height: int, fx: float, fy: float, cx: float, cy: float) -> Intrinsics:
    return Intrinsics("PINHOLE", width, height, (fx, fy, cx, cy))


def has_usual_focal(model: str, share: float) -> bool:
    """Return True if a lens of ``model`` with a focal length of ``share`` long sides is believed."""
    return (MIN_FISHEYE if MODELS[model].fisheye else MIN_FOCAL) <= share <= MAX_FOCAL


def guessed_camera(model: str, width: int, height: int, share: float = COLMAPS_GUESS) -> Intrinsics:
    """Return a camera without distortion whose focal length is ``share`` long sides."""
    from cleargs.capture.colmap import pycolmap

    focal = share * max(width, height)
    guess = pycolmap.Camera.create_from_model_name(1, model, focal, width, height)
    return Intrinsics(model, width, height, tuple(guess.params.tolist()))


@dataclass(frozen=True)
class Pose:
    """World to camera: x_camera = rotation x_world + translation; x right, y down, z forward (OpenCV)."""

    rotation: NDArray[np.float64]  # [3, 3]
    translation: NDArray[np.float64]  # [3]

    @property
    def centre(self) -> NDArray[np.float64]:
        """Camera centre in the world, [3]."""
        return np.asarray(-self.rotation.T @ self.translation)

    @property
    def quaternion(self) -> tuple[float, float, float, float]:
        """Rotation as a unit quaternion w, x, y, z with w >= 0."""
        x, y, z, w = Rotation.from_matrix(self.rotation).as_quat(canonical=True)
        return float(w), float(x), float(y), float(z)

    def with_flipped_axes(self) -> Pose:
        """Return the pose for OpenCV axes in the matrix of the input, which was read with OpenGL axes."""
        rotation = _FLIP @ self.rotation
        return Pose(rotation, -rotation @ self.centre)

    def inverted(self, *, flip: bool) -> Pose:
        """Return the pose for a world-to-camera matrix in the input, which was read as camera to world.

        With ``flip``, the matrix has OpenGL axes, else OpenCV axes.
        """
        rotation, translation = self.rotation.T @ _FLIP, self.centre
        return Pose(_FLIP @ rotation, _FLIP @ translation) if flip else Pose(rotation, translation)

    @staticmethod
    def from_quaternion(wxyz: NDArray[np.float64], translation: NDArray[np.float64]) -> Pose:
        w, x, y, z = wxyz
        return Pose(Rotation.from_quat([x, y, z, w]).as_matrix(), np.asarray(translation, np.float64))


def within_reach(numbers: NDArray[np.float64]) -> bool:
    """Return True if all ``numbers`` are finite and at most `MAX_COORDINATE` in magnitude."""
    return bool(np.isfinite(numbers).all() and np.abs(numbers).max(initial=0.0) <= MAX_COORDINATE)


def rigid_pose(camera_to_world: NDArray[np.float64], name: str, hint: str) -> Pose:  # [3 or 4, 4]
    """Return the pose of a camera-to-world matrix with OpenGL axes (x right, y up, z back).

    The nearest rotation is used: printed poses are orthonormal to a few digits only, and some writers leave
    a scale in them. ``name`` of the frame and ``hint`` are texts of the InputError, which is raised for NaN,
    a coordinate above `MAX_COORDINATE`, a mirror image, or axes whose lengths differ by more than 5 %.
    """
    if not within_reach(camera_to_world):
        raise InputError(f"the pose of {name} is not finite, or out of reach", hint=hint)
    u, stretch, vt = np.linalg.svd(camera_to_world[:3, :3])
    if stretch[2] < 1e-9 or stretch[0] > 1.05 * stretch[2] or np.linalg.det(u @ vt) < 0:
        raise InputError(f"the pose of {name} is not a rotation and a translation", hint=hint)
    rotation = (u @ vt @ _FLIP).T
    return Pose(rotation, -rotation @ camera_to_world[:3, 3])


@dataclass(frozen=True)
class Similarity:
    """x_normalised = rotation (x_input - origin) / scale, all in float64."""

    rotation: NDArray[np.float64]  # [3, 3]
    origin: NDArray[np.float64]  # [3]
    scale: float

    def points(self, xyz: NDArray[np.float64]) -> NDArray[np.float64]:  # [N, 3]
        """Return points of the input's world in the normalised world."""
        return np.asarray((xyz - self.origin) @ self.rotation.T / self.scale)

    def pose(self, pose: Pose) -> Pose:
        """Return the same camera, world to camera, in the normalised world."""
        rotation = pose.rotation @ self.rotation.T
        # The centre is used, not the translation: at world offsets of 1e6 the difference of two large numbers
        # must be taken only once, between centre and origin.
        return Pose(rotation, -rotation @ self.points(pose.centre[None])[0])

    def then(self, after: Similarity) -> Similarity:
        """Return the similarity that applies this one, then ``after``."""
        origin = self.origin + self.scale * self.rotation.T @ after.origin
        return Similarity(after.rotation @ self.rotation, origin, self.scale * after.scale)

    def write(self, ingest: Path) -> None:
        """Write the similarity back to the input's world into a folder of ingest."""
        definition = "x_input = scale * rotation @ x_normalised + translation"
        numbers = {"rotation": self.rotation.T.tolist(), "translation": self.origin.tolist()}
        write_json(ingest / WORLD, {"definition": definition, "scale": self.scale, **numbers})

    @staticmethod
    def read(ingest: Path) -> Similarity:
        """Return the similarity that `write` wrote into a folder of ingest, or raise InputError."""
        try:
            noted = read_json(ingest / WORLD, root=ingest)
            rotation = np.array(noted["rotation"], np.float64).reshape(3, 3)
            origin = np.array(noted["translation"], np.float64).reshape(3)
            return Similarity(rotation.T, origin, float(noted["scale"]))
        except FAULTS as error:
            raise InputError(
                f"{ingest} does not say how it was normalised", hint="run that stage with --force"
            ) from error


def normalise(poses: Sequence[Pose], up: NDArray[np.float64] | None = None) -> Similarity:  # up [3]
    """Return the similarity to the normalised world. Raises InputError if all cameras are at one place.

    If ``up`` is None, it is the mean direction to the tops of the pictures.
    """
    centres = np.stack([pose.centre for pose in poses])
    origin = centres[0] + (centres - centres[0]).mean(axis=0)
    scale = float(np.linalg.norm(centres - origin, axis=1).max())
    if scale <= 1e-9 * max(1e-300, float(np.abs(centres).max())):
        raise InputError(
            "all cameras are at the same place: no point can be triangulated",
            hint="the camera must move, not only turn; check the poses, or set ingest.poses=sfm",
        )
    if up is None:
        up = -np.stack([pose.rotation[1] for pose in poses]).mean(axis=0)
    return Similarity(upright(up), origin, scale)


def upright(up: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the smallest rotation that takes ``up`` to -y.

    If ``up`` is near +y, the axis of the smallest rotation depends on rounding errors. Then a half turn about
    x comes first.
    """
    length = float(np.linalg.norm(up))
    if length < 1e-6:
        return np.eye(3)
    before = _FLIP if up[1] > 0.5 * length else np.eye(3)
    turn, _ = Rotation.align_vectors([[0.0, -1.0, 0.0]], [before @ up / length])
    return np.asarray(turn.as_matrix() @ before)
