"""transforms.json as nerfstudio and instant-ngp write it: cameras and OpenGL camera-to-world poses."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from cleargs.capture.cameras import Camera, Pose
from cleargs.capture.poses import rigid_pose
from cleargs.errors import InputError
from cleargs.media.image import IMAGE_SUFFIXES, read_rgb

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
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
        if not isinstance(data, dict) or "frames" not in data:
            raise ValueError("it has no 'frames'")
        entries = data["frames"]
        if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
            raise ValueError("'frames' is not a list of objects")
        unnamed = [number for number, entry in enumerate(entries) if "file_path" not in entry]
        if unnamed:
            raise ValueError(f"frames[{unnamed[0]}] has no file_path")
    except (OSError, ValueError) as error:
        raise InputError(
            f"cannot read {path}: {error}",
            hint="it must be a JSON object with a 'frames' list, as nerfstudio or instant-ngp write it",
        ) from error
    files = [_find_image(path.parent, entry) for entry in entries]
    missing = [
        str(entry.get("file_path")) for entry, file in zip(entries, files, strict=True) if file is None
    ]
    if missing:
        more = f" and {len(missing) - 3} more" if len(missing) > 3 else ""
        raise InputError(
            f"{path.name} lists images that do not exist: {', '.join(missing[:3])}{more}",
            hint="put the images where file_path says, or remove the entries",
        )
    frames = []
    for entry, file in zip(entries, files, strict=True):
        assert file is not None
        name = str(Path(str(entry["file_path"])).with_suffix(file.suffix))
        mask = _resolve(path.parent, entry["mask_path"]) if "mask_path" in entry else None
        camera = _camera({**data, **entry}, file) if poses else None
        frames.append(TransformsFrame(name, file, mask, camera, _pose(entry, name) if poses else None))
    return frames


def _resolve(root: Path, listed: object) -> Path:
    return root / str(listed).replace("\\", "/")


def _find_image(root: Path, entry: Mapping[str, Any]) -> Path | None:
    """The listed file; where it is listed without an extension, the image of that stem."""
    path = _resolve(root, entry.get("file_path", ""))
    if path.is_file():
        return path
    if path.suffix.lower() in IMAGE_SUFFIXES:
        return None
    for suffix in sorted(IMAGE_SUFFIXES):
        for spelling in (suffix, suffix.upper()):
            candidate = path.with_name(path.name + spelling)
            if candidate.is_file():
                return candidate
    return None


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
        fx, fy = fx or fy or 0.0, fy or fx or 0.0
        cx, cy = float(values.get("cx", width / 2)), float(values.get("cy", height / 2))
        k1, k2, k3, k4, p1, p2 = (float(values.get(key) or 0) for key in ("k1", "k2", "k3", "k4", "p1", "p2"))
    except (TypeError, ValueError) as error:
        raise InputError(
            f"the camera of {image.name} cannot be read: {error}",
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
    except (TypeError, ValueError) as error:
        raise InputError(f"the pose of {name} is not a matrix of numbers", hint=hint) from error
    if matrix.shape not in ((4, 4), (3, 4)):
        raise InputError(f"the pose of {name} is not a 4x4 matrix", hint=hint)
    return rigid_pose(matrix, name, hint)
