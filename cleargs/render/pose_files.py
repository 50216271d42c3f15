"""Poses that a file gives: ``cameras.json`` as `cleargs export` writes it, and ``transforms.json``."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from cleargs.capture.cameras import Pose
from cleargs.capture.poses import Similarity, rigid_pose
from cleargs.errors import InputError
from cleargs.splat.camera import Camera
from cleargs.untrusted import FAULTS, cause, read_json

World = Literal["normalised", "input"]

_OPENGL = np.array([1.0, -1.0, -1.0])
"""By what the axes of an OpenCV camera are multiplied to be those of an OpenGL one."""
_HINT = "give cameras.json as `cleargs export` writes it, or transforms.json as nerfstudio does"


def read_poses(path: Path, lens: Camera, similarity: Similarity, world: World | None = None) -> list[Camera]:
    """The cameras that ``path`` lists, in its order, in the run's normalised world.

    What an entry does not say of its lens is that of ``lens``; distortion is passed over, since a render has
    none. ``similarity`` leads from the input's world, in which transforms.json is taken to be, to the
    normalised one, in which cameras.json is; ``world`` says otherwise.

    Raises InputError for a file of another form, or a pose that is no rotation and translation.
    """
    try:
        document = read_json(path)
        if isinstance(document, list):
            usual: World = "normalised"
            listed = [_of_cameras_json(entry, lens, f"camera {n}") for n, entry in enumerate(document)]
        else:
            usual, common = "input", {key: document[key] for key in document if key != "frames"}
            listed = [
                _of_transforms({**common, **entry}, lens, f"frame {n}")
                for n, entry in enumerate(document["frames"])
            ]
        if not listed:
            raise ValueError("it lists no pose")
    except InputError as error:
        raise InputError(f"{path}: {error}", hint=error.hint) from error
    except FAULTS as error:
        raise InputError(f"cannot read {path}: {cause(error)}", hint=_HINT) from error
    normalised = (world or usual) == "normalised"
    return [_posed(camera, pose if normalised else similarity.pose(pose)) for camera, pose in listed]


def _of_cameras_json(entry: Mapping[str, Any], lens: Camera, name: str) -> tuple[Camera, Pose]:
    """An entry in the layout of the Inria code: the camera's position, and its axes in the world."""
    axes = np.array(entry["rotation"], np.float64).reshape(3, 3) * _OPENGL
    place = np.array(entry["position"], np.float64).reshape(3)
    return _with_lens(lens, entry, ("width", "height"), ("fx", "fy")), rigid_pose(
        np.column_stack([axes, place]), name, _HINT
    )


def _of_transforms(entry: Mapping[str, Any], lens: Camera, name: str) -> tuple[Camera, Pose]:
    """An entry of nerfstudio's: an OpenGL camera-to-world matrix, the lens beside it or for all."""
    matrix = np.array(entry["transform_matrix"], np.float64)
    if matrix.shape not in ((4, 4), (3, 4)):
        raise ValueError(f"the transform_matrix of {name} is not 4x4")
    if "camera_angle_x" in entry and "fl_x" not in entry:
        width = float(entry.get("w", lens.width))
        entry = {**entry, "fl_x": 0.5 * width / math.tan(0.5 * float(entry["camera_angle_x"]))}
    return _with_lens(lens, entry, ("w", "h"), ("fl_x", "fl_y")), rigid_pose(matrix, name, _HINT)


def _with_lens(
    lens: Camera, entry: Mapping[str, Any], size: tuple[str, str], focal: tuple[str, str]
) -> Camera:
    """``lens`` with what ``entry`` says of its size, focal lengths and principal point."""
    width, height = (
        int(entry.get(key, usual)) for key, usual in zip(size, (lens.width, lens.height), strict=True)
    )
    scaled = lens if (width, height) == (lens.width, lens.height) else lens.resized(width, height)
    fx = float(entry.get(focal[0], scaled.fx))
    fy = float(entry.get(focal[1], fx if focal[0] in entry else scaled.fy))
    cx, cy = float(entry.get("cx", scaled.cx)), float(entry.get("cy", scaled.cy))
    return replace(scaled, fx=fx, fy=fy, cx=cx, cy=cy)


def _posed(camera: Camera, pose: Pose) -> Camera:
    matrix: NDArray[np.float64] = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = pose.rotation, pose.translation
    return replace(camera, world_to_camera=matrix)
