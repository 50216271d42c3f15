"""COLMAP sparse models on disk. pycolmap reads them, binary or text; ClearGS writes them in binary form.

https://colmap.github.io/format.html
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import NDArray

from cleargs.capture.cameras import Intrinsics, Pose, Similarity, within_reach
from cleargs.capture.colmap import pycolmap
from cleargs.capture.model_text import image_lines
from cleargs.errors import InputError
from cleargs.files import link_or_copy, write_bytes
from cleargs.safe_io import FAULTS, cause, open_regular, read_bytes

_FAULTS: tuple[type[Exception], ...] = (*FAULTS, MemoryError, RuntimeError)
"""`FAULTS`, and the exceptions that pybind11 raises for those of C++."""

_POINT2D = np.dtype([("xy", "<f8", 2), ("point_id", "<i8")])


@dataclass(frozen=True)
class ModelImage:
    """A registered image and the keypoints of it that observe a sparse point."""

    name: str
    camera_id: int
    pose: Pose
    xy: NDArray[np.float64]  # [K, 2] px, the centre of the first pixel is 0.5
    point_ids: NDArray[np.int64]  # [K]

    def select(self, which: NDArray[np.bool_]) -> ModelImage:  # [K]
        """Return the image with these keypoints only."""
        return replace(self, xy=self.xy[which], point_ids=self.point_ids[which])


@dataclass(frozen=True)
class SparseModel:
    """Registered images, their cameras, and sparse points (sorted by id)."""

    cameras: dict[int, Intrinsics]
    images: dict[int, ModelImage]
    point_ids: NDArray[np.int64]  # [P]
    xyz: NDArray[np.float64]  # [P, 3]
    error: NDArray[np.float64]  # [P] mean reprojection error, px
    dropped: int = 0
    """Number of points that were left out, because they are not finite or too far."""
    rgb: NDArray[np.uint8] | None = None  # [P, 3] sRGB, of a model as it was read

    def select(self, which: NDArray[np.bool_]) -> SparseModel:  # [P]
        """Return the model with these points only, also in the images."""
        ids = self.point_ids[which]
        images = {key: image.select(np.isin(image.point_ids, ids)) for key, image in self.images.items()}
        rgb = None if self.rgb is None else self.rgb[which]
        error = self.error[which]
        return replace(self, images=images, point_ids=ids, xyz=self.xyz[which], error=error, rgb=rgb)

    def moved(self, similarity: Similarity) -> SparseModel:
        """Return the model in another world; every point keeps its place in every image."""
        images = {key: replace(image, pose=similarity.pose(image.pose)) for key, image in self.images.items()}
        return replace(self, images=images, xyz=similarity.points(self.xyz))

    def shifted(self, shifts: Mapping[str, tuple[float, float]]) -> SparseModel:
        """Return the model with a camera per image, its centre moved by ``shifts``, px."""
        if not shifts:
            return self
        images = {key: replace(image, camera_id=key) for key, image in self.images.items()}
        cameras = {
            key: self.cameras[image.camera_id].moved(*shifts.get(image.name, (0.0, 0.0)))
            for key, image in self.images.items()
        }
        return replace(self, cameras=cameras, images=images)

    def misses(self) -> NDArray[np.float64]:
        """Return the distance of every keypoint from its projected point, px; infinite behind the camera."""
        found = [np.zeros(0)]
        for image in self.images.values():
            xyz = self.xyz[np.searchsorted(self.point_ids, image.point_ids)]
            rays = xyz @ image.pose.rotation.T + image.pose.translation
            xy = np.asarray(self.cameras[image.camera_id].colmap().img_from_cam(rays)).reshape(-1, 2)
            off = np.linalg.norm(xy - image.xy, axis=1)
            found.append(np.where(np.isfinite(off), off, np.inf))
        return np.concatenate(found)


def read_model(folder: Path) -> SparseModel:
    """Read a binary or text model. Raises InputError if it is damaged or incomplete.

    It may have no points. Text may lack the empty lines of images without keypoints: some programs omit them.
    """
    kind = "bin" if (folder / "images.bin").exists() else "txt"
    hint = "export cameras, images and points3D again, all binary or all text, or set ingest.poses=sfm"
    if not (folder / f"cameras.{kind}").exists():
        raise InputError(f"the COLMAP model in {folder} has no cameras.{kind}", hint=hint)
    try:
        with TemporaryDirectory(prefix="cleargs-model-") as alone:
            # Next to these files pycolmap would also read rigs and frames, whose sizes are not checked.
            for name, end in _ENDS.items():
                file, copy = folder / f"{name}.{kind}", Path(alone, f"{name}.{kind}")
                if name == "points3D" and not file.exists():
                    copy.write_bytes(bytes(8 if kind == "bin" else 0))
                elif kind == "txt" and name == "images":
                    copy.write_text("\n".join(chain(*image_lines(file))) + "\n", encoding="utf-8")
                else:
                    if kind == "bin":
                        _require_whole(file, end)
                    open_regular(file).close()
                    link_or_copy(file.resolve(), copy)
            return _converted(pycolmap.Reconstruction(alone))
    except _FAULTS as error:
        # The message of a failed check in COLMAP starts with the line of the source.
        reason = "a file breaks off" if isinstance(error, struct.error) else cause(error).rpartition("] ")[2]
        raise InputError(f"cannot read the COLMAP model in {folder}: {reason}", hint=hint) from error


def write_model(folder: Path, model: SparseModel, rgb: NDArray[np.uint8]) -> None:  # rgb [P, 3]
    """Write a binary model that COLMAP and trainers read. Raises StoreError when the disk is full."""
    folder.mkdir(parents=True, exist_ok=True)
    cameras = [struct.pack("<Q", len(model.cameras))]
    for camera_id, camera in sorted(model.cameras.items()):
        kind = camera.colmap().model.value
        cameras.append(struct.pack("<iiQQ", camera_id, kind, camera.width, camera.height))
        cameras.append(struct.pack(f"<{len(camera.params)}d", *camera.params))
    write_bytes(folder / "cameras.bin", b"".join(cameras))

    tracks: dict[int, list[tuple[int, int]]] = {int(point_id): [] for point_id in model.point_ids}
    images = [struct.pack("<Q", len(model.images))]
    for image_id, image in sorted(model.images.items()):
        pose = image.pose
        images.append(struct.pack("<i7di", image_id, *pose.quaternion, *pose.translation, image.camera_id))
        images.append(image.name.encode() + b"\0" + struct.pack("<Q", len(image.xy)))
        points2d = np.empty(len(image.xy), _POINT2D)
        points2d["xy"], points2d["point_id"] = image.xy, image.point_ids
        images.append(points2d.tobytes())
        for index, point_id in enumerate(image.point_ids.tolist()):
            tracks[point_id].append((image_id, index))
    write_bytes(folder / "images.bin", b"".join(images))

    points = [struct.pack("<Q", len(model.point_ids))]
    for point_id, xyz, colour, error in zip(
        model.point_ids.tolist(), model.xyz.tolist(), rgb.tolist(), model.error.tolist(), strict=True
    ):
        track = tracks[point_id]
        points.append(struct.pack("<Q3d3BdQ", point_id, *xyz, *colour, error, len(track)))
        points.append(b"".join(struct.pack("<ii", *element) for element in track))
    write_bytes(folder / "points3D.bin", b"".join(points))


def transform_model(
    model: SparseModel, *, scale: float, rotation: NDArray[np.float64], translation: NDArray[np.float64]
) -> SparseModel:
    """Return ``model`` after the map x -> scale rotation [3, 3] x + translation [3]."""
    return model.moved(Similarity(rotation, -rotation.T @ translation / scale, 1 / scale))


def _camera_end(data: bytes, at: int) -> int:
    kind = pycolmap.CameraModelId(*struct.unpack_from("<4xi", data, at))
    return at + 24 + 8 * len(pycolmap.Camera.create_from_model_id(1, kind, 1.0, 1, 1).params)


def _image_end(data: bytes, at: int) -> int:
    end = data.find(b"\0", at + 64)  # end of the name
    if end < 0:
        raise struct.error
    return end + 9 + _POINT2D.itemsize * _count(data, end + 1)


_ENDS: dict[str, Callable[[bytes, int], int]] = {
    "cameras": _camera_end,
    "images": _image_end,
    "points3D": lambda data, at: at + 51 + 8 * _count(data, at + 43),
}
"""File of a model -> function from the position of a binary entry to the position after it."""


def _require_whole(file: Path, end: Callable[[bytes, int], int]) -> None:
    """Raise if the counts in a binary file do not fit its size: pycolmap would read zeros without end."""
    data = read_bytes(file)
    at = 8
    for _ in range(_count(data, 0)):
        at = end(data, at)
    if at != len(data):
        raise ValueError(f"{file.name} does not have the size that its counts say")


def _count(data: bytes, at: int) -> int:
    return int(struct.unpack_from("<Q", data, at)[0])


def _converted(model: pycolmap.Reconstruction) -> SparseModel:
    points = sorted(model.points3D.items())
    point_ids = np.array([key for key, _ in points], np.int64)
    xyz = np.array([point.xyz for _, point in points], np.float64).reshape(-1, 3)
    errors = np.array([point.error for _, point in points], np.float64)
    rgb = np.array([point.color for _, point in points], np.uint8).reshape(-1, 3)
    usable = np.isfinite(xyz).all(axis=1) & np.isfinite(errors)
    cameras = {
        key: Intrinsics(camera.model.name, camera.width, camera.height, tuple(camera.params.tolist()))
        for key, camera in sorted(model.cameras.items())
    }
    images = {
        key: _image(image, point_ids[usable]) for key, image in sorted(model.images.items()) if image.has_pose
    }
    dropped = int((~usable).sum())
    return SparseModel(cameras, images, point_ids[usable], xyz[usable], errors[usable], dropped, rgb[usable])


def _image(image: pycolmap.Image, known: NDArray[np.int64]) -> ModelImage:
    """Return the image with its keypoints that observe a known point; repeated observations count once."""
    keypoints = image.get_observation_points2D()
    xy = np.array([keypoint.xy for keypoint in keypoints], np.float64).reshape(-1, 2)
    ids = np.array([keypoint.point3D_id for keypoint in keypoints], np.int64)
    keep = np.isin(ids, known) & np.isfinite(xy).all(axis=1)
    first = np.zeros(len(ids), bool)
    first[np.unique(np.where(keep, ids, -1), return_index=True)[1]] = True
    placed = image.cam_from_world()
    turn, translation = np.roll(placed.rotation.quat, 1), placed.translation  # w first
    if not within_reach(np.array([*turn, *translation])) or not 1e-6 < np.abs(turn).max() < 1e6:
        raise ValueError(f"the pose of {image.name} is not finite, or out of reach")
    pose = Pose.from_quaternion(turn, translation)
    return ModelImage(image.name, image.camera_id, pose, xy[keep & first], ids[keep & first])
