"""transforms.json as nerfstudio and instant-ngp write it: cameras and OpenGL camera-to-world poses."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from cleargs.capture.cameras import Camera, Pose
from cleargs.capture.listing import read_listing
from cleargs.capture.poses import rigid_pose
from cleargs.errors import InputError
from cleargs.media.image import read_rgb
from cleargs.untrusted import FAULTS, cause

_FISHEYE = frozenset({"OPENCV_FISHEYE", "FISHEYE"})
_PERSPECTIVE = frozenset({"OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "PERSPECTIVE", "SIMPLE_RADIAL", "RADIAL"})


@dataclass(frozen=True)
class TransformsFrame:
    """One entry of ``frames``."""

    name: str
    """``file_path`` as listed, with the extension of the file found."""
    path: Path
    mask: Path | None
    camera: Camera | None
    pose: Pose | None


def read_transforms(path: Path, *, poses: bool) -> list[TransformsFrame]:
    """The frames that ``path`` lists, in its order; without ``poses``, only their images.

    Further entries, such as 3dgs-deblur's velocities and exposure times or nerfstudio's ``ply_file_path``,
    are passed over.

    Raises InputError for damaged JSON, missing images, missing or NaN poses, unknown cameras.
    """
    listing = read_listing(path)
    missing = [entry.values["file_path"] for entry in listing.entries if entry.image is None]
    if missing:
        more = f" and {len(missing) - 3} more" if len(missing) > 3 else ""
        raise InputError(
            f"{path.name} lists images that do not exist: {', '.join(missing[:3])}{more}",
            hint="put the images where file_path says, or remove the entries",
        )
    frames = []
    for entry in listing.entries:
        assert entry.image is not None
        # The ending may be left out, dots in the name are none, and Windows has other slashes.
        name = str(Path(entry.values["file_path"].replace("\\", "/")).with_name(entry.image.name))
        if entry.mask is None and "mask_path" in entry.values:
            raise InputError(
                f"{name} names the mask {entry.values['mask_path']}, which does not exist",
                hint="put the mask there, or remove mask_path",
            )
        camera = _camera({**listing.common, **entry.values}, entry.image) if poses else None
        pose = _pose(entry.values, name) if poses else None
        frames.append(TransformsFrame(name, entry.image, entry.mask, camera, pose))
    return frames


def _camera(values: Mapping[str, Any], image: Path) -> Camera:
    """The camera of a frame: its own entries over those of the whole file."""
    try:
        if "w" in values and "h" in values:
            width, height = int(values["w"]), int(values["h"])
        else:
            height, width = read_rgb(image).shape[:2]
        fx = _focal(values, "x", width)
        fy = _focal(values, "y", height)
        if fx is None and fy is None:
            raise ValueError("neither fl_x nor camera_angle_x is given")
        fx, fy = _either(fx, fy), _either(fy, fx)
        cx, cy = float(values.get("cx", width / 2)), float(values.get("cy", height / 2))
        k1, k2, k3, k4, p1, p2 = (float(values.get(key) or 0) for key in ("k1", "k2", "k3", "k4", "p1", "p2"))
    except FAULTS as error:
        raise InputError(
            f"the camera of {image.name} cannot be read: {cause(error)}",
            hint="give w, h, fl_x, fl_y, cx, cy (or camera_angle_x), or set ingest.poses=sfm",
        ) from error
    model = str(values.get("camera_model", "OPENCV")).upper()
    if model in _FISHEYE or values.get("is_fisheye"):
        return Camera("OPENCV_FISHEYE", width, height, (fx, fy, cx, cy, k1, k2, k3, k4))
    if model not in _PERSPECTIVE or k4:
        what = f"camera_model {model}" if model not in _PERSPECTIVE else "a perspective camera with k4"
        raise InputError(
            f"{what} is not supported", hint="undistort the images first, or use OPENCV or OPENCV_FISHEYE"
        )
    if k3:
        return Camera("FULL_OPENCV", width, height, (fx, fy, cx, cy, k1, k2, p1, p2, k3, 0, 0, 0))
    if k1 or k2 or p1 or p2:
        return Camera("OPENCV", width, height, (fx, fy, cx, cy, k1, k2, p1, p2))
    return Camera("PINHOLE", width, height, (fx, fy, cx, cy))


def _either(focal: float | None, other: float | None) -> float:
    """``focal``, or the other axis's where it is not given; 0 is given, and refused later."""
    return other or 0.0 if focal is None else focal


def _focal(values: Mapping[str, Any], axis: str, size: int) -> float | None:
    if values.get(f"fl_{axis}") is not None:
        return float(values[f"fl_{axis}"])
    if values.get(f"camera_angle_{axis}") is not None:
        return 0.5 * size / math.tan(0.5 * float(values[f"camera_angle_{axis}"]))
    return None


def _pose(entry: Mapping[str, Any], name: str) -> Pose:
    hint = "remove the frame or correct its transform_matrix, or set ingest.poses=sfm to find the poses anew"
    if "transform_matrix" not in entry:
        raise InputError(f"{name} has no pose (transform_matrix)", hint=hint)
    try:
        matrix = np.array(entry["transform_matrix"], np.float64)
    except FAULTS as error:
        raise InputError(f"the pose of {name} is not a matrix of numbers", hint=hint) from error
    if matrix.shape not in ((4, 4), (3, 4)):
        raise InputError(f"the pose of {name} is not a 4x4 matrix", hint=hint)
    return rigid_pose(matrix, name, hint)
