"""transforms.json as nerfstudio and instant-ngp write it: cameras and OpenGL camera-to-world poses."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from cleargs.capture.capture import Capture, External, SourceFrame
from cleargs.capture.config import CaptureConfig
from cleargs.capture.folders import chosen, frame_key, mask_externals, name_below_images
from cleargs.errors import InputError
from cleargs.media import IMAGE_SUFFIXES
from cleargs.safe_io import FAULTS, cause, read_json

if TYPE_CHECKING:
    from cleargs.capture.cameras import Intrinsics, Pose

_FISHEYE = frozenset({"OPENCV_FISHEYE", "FISHEYE"})
_PERSPECTIVE = frozenset({"OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "PERSPECTIVE", "SIMPLE_RADIAL", "RADIAL"})


class _Entry(NamedTuple):
    """One entry of ``frames`` and the files that it names."""

    values: Mapping[str, Any]
    image: Path | None
    """None where there is none."""
    mask: Path | None
    """None where it names none, or there is none."""


def detect(source: Path, *, poses: bool) -> bool:
    """See `Layout.detect`: it lists images, with or without poses."""
    return (source / "transforms.json").is_file()


def externals(source: Path, config: CaptureConfig) -> Mapping[str, External]:
    """See `Layout.externals`. Raises InputError where the file cannot be read."""
    file = source / "transforms.json"
    _, entries = _read_listing(file)
    images = {entry.values["file_path"]: entry.image for entry in entries}
    masks = {entry.values.get("mask_path"): entry.mask for entry in entries}
    found = {str(name): path for name, path in {**masks, **images}.items() if path is not None}
    return {"transforms": file, "images": found, **mask_externals(source)}


def open_capture(source: Path, config: CaptureConfig) -> Capture:
    """See `Layout.open_capture`."""
    frames = read_transforms(source / "transforms.json", poses=config.poses == "auto")
    frames.sort(key=lambda frame: frame_key(frame.name))
    names = [name_below_images(frame.name) for frame in frames]
    return Capture("transforms", chosen(frames, source, config.max_frames, names), len(frames))


def read_transforms(path: Path, *, poses: bool) -> list[SourceFrame]:
    """The frames that ``path`` lists, in its order; without ``poses``, only their images.

    A frame's name is its ``file_path`` as listed, with the extension of the file found.

    Further entries, such as 3dgs-deblur's velocities and exposure times or nerfstudio's ``ply_file_path``,
    are passed over.

    Raises InputError for damaged JSON, missing images, missing or NaN poses, unknown cameras.
    """
    common, entries = _read_listing(path)
    missing = [entry.values["file_path"] for entry in entries if entry.image is None]
    if missing:
        more = f" and {len(missing) - 3} more" if len(missing) > 3 else ""
        raise InputError(
            f"{path.name} lists images that do not exist: {', '.join(missing[:3])}{more}",
            hint="put the images where file_path says, or remove the entries",
        )
    frames = []
    for entry in entries:
        assert entry.image is not None
        # The ending may be left out, dots in the name are none, and Windows has other slashes.
        name = str(Path(entry.values["file_path"].replace("\\", "/")).with_name(entry.image.name))
        if entry.mask is None and "mask_path" in entry.values:
            raise InputError(
                f"{name} names the mask {entry.values['mask_path']}, which does not exist",
                hint="put the mask there, or remove mask_path",
            )
        camera = _camera({**common, **entry.values}, entry.image) if poses else None
        pose = _pose(entry.values, name) if poses else None
        frames.append(SourceFrame(name, entry.image, mask=entry.mask, camera=camera, pose=pose))
    return frames


def _camera(values: Mapping[str, Any], image: Path) -> Intrinsics:
    """The camera of a frame: its own entries over those of the whole file."""
    from cleargs.capture.cameras import Intrinsics

    try:
        if "w" in values and "h" in values:
            width, height = int(values["w"]), int(values["h"])
        else:
            from cleargs.media.image import read_rgb

            height, width = read_rgb(image).shape[:2]
        fx, fy = _focal(values, "x", width), _focal(values, "y", height)
        fx = fy if fx is None else fx
        fy = fx if fy is None else fy
        if fx is None or fy is None:
            raise ValueError("neither fl_x nor camera_angle_x is given")
        cx, cy = float(values.get("cx", width / 2)), float(values.get("cy", height / 2))
        k1, k2, k3, k4, p1, p2 = (float(values.get(key) or 0) for key in ("k1", "k2", "k3", "k4", "p1", "p2"))
    except FAULTS as error:
        raise InputError(
            f"the camera of {image.name} cannot be read: {cause(error)}",
            hint="give w, h, fl_x, fl_y, cx, cy (or camera_angle_x), or set ingest.poses=sfm",
        ) from error
    model = str(values.get("camera_model", "OPENCV")).upper()
    if model in _FISHEYE or values.get("is_fisheye"):
        return Intrinsics("OPENCV_FISHEYE", width, height, (fx, fy, cx, cy, k1, k2, k3, k4))
    if model not in _PERSPECTIVE or k4:
        what = f"camera_model {model}" if model not in _PERSPECTIVE else "a perspective camera with k4"
        raise InputError(
            f"{what} is not supported", hint="undistort the images first, or use OPENCV or OPENCV_FISHEYE"
        )
    if k3:
        return Intrinsics("FULL_OPENCV", width, height, (fx, fy, cx, cy, k1, k2, p1, p2, k3, 0, 0, 0))
    if k1 or k2 or p1 or p2:
        return Intrinsics("OPENCV", width, height, (fx, fy, cx, cy, k1, k2, p1, p2))
    return Intrinsics("PINHOLE", width, height, (fx, fy, cx, cy))


def _focal(values: Mapping[str, Any], axis: str, size: int) -> float | None:
    if values.get(f"fl_{axis}") is not None:
        return float(values[f"fl_{axis}"])
    if values.get(f"camera_angle_{axis}") is not None:
        return 0.5 * size / math.tan(0.5 * float(values[f"camera_angle_{axis}"]))
    return None


def _pose(entry: Mapping[str, Any], name: str) -> Pose:
    import numpy as np

    from cleargs.capture.cameras import rigid_pose

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


def _read_listing(path: Path) -> tuple[Mapping[str, Any], list[_Entry]]:
    """All that stands next to ``frames`` in transforms.json, and the entries of ``frames``.

    Raises InputError where it is damaged or an entry names no image.
    """
    try:
        data = read_json(path)
        if not isinstance(data, dict) or "frames" not in data:
            raise ValueError("it has no 'frames'")
        frames = data.pop("frames")
        if not isinstance(frames, list) or not all(isinstance(values, dict) for values in frames):
            raise ValueError("'frames' is not a list of objects")
        entries = []
        for number, values in enumerate(frames):
            if not isinstance(values.get("file_path"), str):
                raise ValueError(f"frames[{number}] has no file_path")
            if not isinstance(values.get("mask_path", ""), str):
                raise ValueError(f"frames[{number}] has a mask_path that is no text")
            mask = _find(path.parent, values["mask_path"]) if "mask_path" in values else None
            entries.append(_Entry(values, _find(path.parent, values["file_path"]), mask))
        return data, entries
    except FAULTS as error:
        raise InputError(
            f"cannot read {path}: {cause(error)}",
            hint="it must be a JSON object with a 'frames' list, as nerfstudio or instant-ngp write it",
        ) from error


def _find(root: Path, listed: str) -> Path | None:
    """The listed file; where it is listed without an extension, the image of that stem."""
    path = root / listed.replace("\\", "/")
    candidates = [path]
    if path.name and path.suffix.lower() not in IMAGE_SUFFIXES:
        endings = [ending for suffix in sorted(IMAGE_SUFFIXES) for ending in (suffix, suffix.upper())]
        candidates += [path.with_name(path.name + ending) for ending in endings]
    return next((candidate for candidate in candidates if candidate.is_file()), None)
