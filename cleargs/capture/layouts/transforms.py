"""transforms.json as nerfstudio and instant-ngp write it: cameras and OpenGL camera-to-world poses."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from cleargs.capture.camera_models import BY_TRANSFORMS, FISHEYE
from cleargs.capture.capture import Capture, External, SourceFrame
from cleargs.capture.config import CaptureConfig
from cleargs.capture.folders import (
    chosen,
    folders_to_search,
    frame_key,
    image_files,
    is_wanted,
    mask_externals,
    name_below_images,
    require_most,
)
from cleargs.errors import InputError
from cleargs.safe_io import FAULTS, faults_as, read_json

if TYPE_CHECKING:
    from cleargs.capture.cameras import Intrinsics, Pose


class _Entry(NamedTuple):
    """One entry of ``frames`` and the files that it names."""

    values: Mapping[str, Any]
    image: Path | None
    """None if the file does not exist."""
    mask: Path | None
    """None if the entry names no mask, or the file does not exist."""


_LISTING = "transforms.json"
_SPLIT = tuple(f"transforms_{part}.json" for part in ("train", "test", "val"))
"""Blender's form: a file per part. The frames of test (of val if there is no test) are held out."""


def detect(source: Path, config: CaptureConfig) -> bool:
    """See `Layout.detect`. The file counts even if its poses are not used, because it lists images."""
    return bool(_listings(source))


def externals(source: Path, config: CaptureConfig) -> Mapping[str, External]:
    """See `Layout.externals`. Raises InputError if a file cannot be read."""
    files = _listings(source)
    found: dict[str, Path] = {}
    for file in files:
        _, entries = _read_listing(file)
        images = {entry.values["file_path"]: entry.image for entry in entries}
        masks = {entry.values.get("mask_path"): entry.mask for entry in entries}
        found |= {str(name): path for name, path in {**masks, **images}.items() if path is not None}
    return {**{file.stem: file for file in files}, "images": found, **mask_externals(source)}


def open_capture(source: Path, config: CaptureConfig) -> Capture:
    files = _listings(source)
    notes: list[str] = []
    frames: list[SourceFrame] = []
    for file in files:
        listed = read_transforms(file, poses=config.uses_poses, notes=notes)
        frames += [replace(frame, test=file != files[0]) for frame in listed]
    split = _split_files(source)
    if files == split[:2] and len(split) > 2:
        notes.append(f"{split[2].name} is not read: the test views are those of {split[1].name}")
    folders = {frame.path.parent for frame in frames}
    frames = [frame for frame in frames if is_wanted(frame.path, source, config)]
    others = {path for folder in folders for path in image_files(folder)}
    others -= {path for frame in frames for path in (frame.path, frame.mask)}
    lists = f"{' and '.join(file.name for file in files)} list{'s' * (len(files) == 1)}"
    told = f"read: {len(frames)} pictures that {lists}"
    told += f"; left out: {len(others)} others next to them" if others else ""
    frames.sort(key=lambda frame: frame_key(frame.name))
    names = [name_below_images(frame.name) for frame in frames]
    taken = chosen(frames, source, config.max_frames, names)
    return Capture("transforms", taken, len(frames), available=tuple(frames), told=told, notes=tuple(notes))


def _split_files(source: Path) -> list[Path]:
    return [source / name for name in _SPLIT if (source / name).is_file()]


def _listings(source: Path) -> list[Path]:
    """Return the files that list the frames of ``source``: transforms.json, or a split's first two."""
    whole = source / _LISTING
    return [whole] if whole.is_file() else _split_files(source)[:2]


def read_transforms(path: Path, *, poses: bool, notes: list[str] | None = None) -> list[SourceFrame]:
    """Return the frames that ``path`` lists, in its order; without ``poses``, only their images.

    A frame's name is its ``file_path`` as listed, with the extension of the file found. Further entries, such
    as 3dgs-deblur's velocities and exposure times or nerfstudio's ``ply_file_path``, are ignored. ``notes``
    receives a note on missing images, which are left out; if it is None, they are an error. Raises InputError
    for damaged JSON, if most images are missing, for missing or NaN poses, and for unknown cameras.
    """
    common, entries = _read_listing(path)
    missing = [entry.values["file_path"] for entry in entries if entry.image is None]
    lost = require_most(missing, len(entries) if notes is not None else 0, path.name)
    if notes is not None:
        notes += lost
    frames = []
    for entry in entries:
        if entry.image is None:
            continue
        # A listed name may have no extension, may have dots, and has backslashes on Windows.
        name = Path(entry.values["file_path"].replace("\\", "/")).with_name(entry.image.name).as_posix()
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
    """Return the camera of a frame from its own values, else from those of the whole file."""
    from cleargs.capture.cameras import Intrinsics

    hint = "give w, h, fl_x, fl_y, cx, cy (or camera_angle_x), or set ingest.poses=sfm"
    with faults_as(InputError, f"the camera of {image.name} cannot be read", hint=hint):
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
    model = str(values.get("camera_model", "OPENCV")).upper()
    known = BY_TRANSFORMS.get(model)
    if (known is not None and known.fisheye) or values.get("is_fisheye"):
        return Intrinsics(FISHEYE, width, height, (fx, fy, cx, cy, k1, k2, k3, k4))
    if known is None or k4:
        what = f"camera_model {model}" if known is None else "a perspective camera with k4"
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

    hint = "remove the frame or correct its transform_matrix, or set ingest.poses=sfm to find other poses"
    if "transform_matrix" not in entry:
        raise InputError(f"{name} has no pose (transform_matrix)", hint=hint)
    try:
        matrix = np.array(entry["transform_matrix"], np.float64)
        if matrix.shape not in ((4, 4), (3, 4)):
            raise ValueError
    except FAULTS as error:
        raise InputError(f"the pose of {name} is not a 4x4 matrix of numbers", hint=hint) from error
    return rigid_pose(matrix, name, hint)


def _read_listing(path: Path) -> tuple[Mapping[str, Any], list[_Entry]]:
    """Return the values next to ``frames``, and its entries.

    Raises InputError if the file is damaged, or an entry names no image.
    """
    hint = "it must be a JSON object with a 'frames' list, as nerfstudio or instant-ngp write it"
    with faults_as(InputError, f"cannot read {path}", hint=hint):
        data = read_json(path)
        if not isinstance(data, dict) or "frames" not in data:
            raise ValueError("it has no 'frames'")
        frames = data.pop("frames")
        if not isinstance(frames, list) or not all(isinstance(values, dict) for values in frames):
            raise ValueError("'frames' is not a list of objects")
        entries = []
        find = _finder(path.parent)
        for number, values in enumerate(frames):
            if not isinstance(values.get("file_path"), str):
                raise ValueError(f"frames[{number}] has no file_path")
            if not isinstance(values.get("mask_path", ""), str):
                raise ValueError(f"frames[{number}] has a mask_path that is not text")
            mask = find(values["mask_path"]) if "mask_path" in values else None
            entries.append(_Entry(values, find(values["file_path"]), mask))
        return data, entries


def _finder(root: Path) -> Callable[[str], Path | None]:
    """Return a function that finds the file that a listing in ``root`` names.

    If the file is missing, it finds the image with this stem there, or in others if the folder is missing.
    """

    @cache
    def by_stem(folder: Path) -> dict[str, Path]:
        return {file.stem.lower(): file for file in sorted(image_files(folder), reverse=True)}

    others = cache(partial(folders_to_search, root))

    def find(listed: str) -> Path | None:
        path = root / listed.replace("\\", "/")
        if path.is_file():
            return path
        # A listed name may have no extension, another one, or a dot that starts none.
        stems = path.name.lower(), path.stem.lower()
        folders = [path.parent] if path.parent.is_dir() else others()
        found = (by_stem(folder).get(stem) for folder in folders for stem in stems)
        return next((file for file in found if file is not None), None)

    return find
