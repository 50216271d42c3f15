"""COLMAP sparse models on disk (binary and text), without COLMAP: a damaged file is an error, not an abort.

Binary models hold cameras.bin, images.bin and points3D.bin; what newer versions add (rigs.bin, frames.bin)
repeats the poses and is not needed. https://colmap.github.io/format.html
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cleargs.capture.cameras import Camera, Pose
from cleargs.capture.poses import within_reach
from cleargs.errors import InputError
from cleargs.files import write_bytes
from cleargs.untrusted import FAULTS, cause, read_bytes, read_text

MODEL_NAMES = (
    "SIMPLE_PINHOLE",
    "PINHOLE",
    "SIMPLE_RADIAL",
    "RADIAL",
    "OPENCV",
    "OPENCV_FISHEYE",
    "FULL_OPENCV",
    "FOV",
    "SIMPLE_RADIAL_FISHEYE",
    "RADIAL_FISHEYE",
    "THIN_PRISM_FISHEYE",
)
"""Camera models by COLMAP's model id."""

N_PARAMS = (3, 4, 4, 5, 8, 8, 12, 5, 4, 5, 12)
"""Number of parameters of each."""

_POINT2D = np.dtype([("xy", "<f8", 2), ("point_id", "<i8")])


@dataclass(frozen=True)
class ModelImage:
    """A registered image and the keypoints of it that observe a sparse point."""

    name: str
    camera_id: int
    pose: Pose
    xy: NDArray[np.float64]  # [K, 2] px, the centre of the first pixel is 0.5
    point_ids: NDArray[np.int64]  # [K]


@dataclass(frozen=True)
class SparseModel:
    """Registered images, their cameras, and sparse points (sorted by id)."""

    cameras: dict[int, Camera]
    images: dict[int, ModelImage]
    point_ids: NDArray[np.int64]  # [P]
    xyz: NDArray[np.float64]  # [P, 3]
    error: NDArray[np.float64]  # [P] mean reprojection error, px
    dropped: int = 0
    """Points of the file that are not finite, and were left out."""


def read_model(folder: Path) -> SparseModel:
    """Read a binary or text model. Raises InputError when it is damaged or incomplete."""
    try:
        if (folder / "images.bin").exists():
            return _read_binary(folder)
        return _read_text(folder)
    except FAULTS as error:
        reason = "a file breaks off" if isinstance(error, struct.error) else cause(error)
        raise InputError(
            f"cannot read the COLMAP model in {folder}: {reason}",
            hint="export cameras, images and points3D again, all binary or all text, or set ingest.poses=sfm",
        ) from error


def write_model(folder: Path, model: SparseModel, rgb: NDArray[np.uint8]) -> None:  # rgb [P, 3]
    """Write a binary model that COLMAP and trainers read. Raises StoreError when the disk is full."""
    folder.mkdir(parents=True, exist_ok=True)
    cameras = [struct.pack("<Q", len(model.cameras))]
    for camera_id, camera in sorted(model.cameras.items()):
        cameras.append(
            struct.pack("<iiQQ", camera_id, MODEL_NAMES.index(camera.model), camera.width, camera.height)
        )
        cameras.append(struct.pack(f"<{len(camera.params)}d", *camera.params))
    write_bytes(folder / "cameras.bin", b"".join(cameras))

    tracks: dict[int, list[tuple[int, int]]] = {int(point_id): [] for point_id in model.point_ids}
    images = [struct.pack("<Q", len(model.images))]
    for image_id, image in sorted(model.images.items()):
        images.append(
            struct.pack("<i7di", image_id, *image.pose.quaternion, *image.pose.translation, image.camera_id)
        )
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


class _Reader:
    """A binary file read from front to back."""

    def __init__(self, path: Path) -> None:
        self.data = read_bytes(path)
        self.position = 0

    def unpack(self, layout: str) -> tuple[int | float, ...]:
        values = struct.unpack_from("<" + layout, self.data, self.position)
        self.position += struct.calcsize("<" + layout)
        return values

    def count(self) -> int:
        (number,) = self.unpack("Q")
        if number > len(self.data):
            raise ValueError("an impossible count")
        return int(number)

    def skip(self, size: int) -> None:
        if size > len(self.data) - self.position:
            raise ValueError("an impossible count")
        self.position += size

    def text(self) -> str:
        end = self.data.index(b"\0", self.position)
        text = self.data[self.position : end].decode()
        self.position = end + 1
        return text

    def array(self, dtype: np.dtype[np.void], count: int) -> NDArray[np.void]:
        values = np.frombuffer(self.data, dtype, count, self.position)
        self.position += dtype.itemsize * count
        return values


def _observed(xy: NDArray[np.float64], ids: NDArray[np.int64], known: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Keypoints that observe a known point; a point observed twice in one image counts once."""
    keep = np.isin(ids, known) & np.isfinite(xy).all(axis=1)
    first = np.zeros(len(ids), bool)
    first[np.unique(np.where(keep, ids, -1), return_index=True)[1]] = True
    return keep & first


def _model_image(
    name: str,
    camera_id: int,
    pose: Pose,
    xy: NDArray[np.float64],
    ids: NDArray[np.int64],
    known: NDArray[np.int64],
) -> ModelImage:
    keep = _observed(xy, ids, known)
    return ModelImage(name, camera_id, pose, xy[keep], ids[keep])


def _read_binary(folder: Path) -> SparseModel:
    reader = _Reader(folder / "cameras.bin")
    cameras: dict[int, Camera] = {}
    for _ in range(reader.count()):
        key, model, width, height = (int(value) for value in reader.unpack("iiQQ"))
        if not 0 <= model < len(MODEL_NAMES):
            raise ValueError(f"camera model {model} is not supported")
        params = tuple(float(value) for value in reader.unpack(f"{N_PARAMS[model]}d"))
        cameras[key] = Camera(MODEL_NAMES[model], width, height, params)

    reader = _Reader(folder / "points3D.bin")
    ids: list[int] = []
    xyz: list[tuple[float, ...]] = []
    errors: list[float] = []
    for _ in range(reader.count()):
        point_id, x, y, z, _r, _g, _b, error, length = reader.unpack("Q3d3BdQ")
        reader.skip(8 * int(length))
        ids.append(int(point_id))
        xyz.append((x, y, z))
        errors.append(error)
    point_ids, positions, residuals, dropped = _sorted_points(ids, xyz, errors)

    reader = _Reader(folder / "images.bin")
    images: dict[int, ModelImage] = {}
    for _ in range(reader.count()):
        image_id, *pose, camera_id = reader.unpack("i7di")
        name = reader.text()
        points2d = reader.array(_POINT2D, reader.count())
        images[int(image_id)] = _model_image(
            name, int(camera_id), _pose(name, pose), points2d["xy"], points2d["point_id"], point_ids
        )
    return SparseModel(cameras, images, point_ids, positions, residuals, dropped)


def _read_text(folder: Path) -> SparseModel:
    cameras: dict[int, Camera] = {}
    for line in _lines(folder / "cameras.txt"):
        camera_id, model, width, height, *params = line.split()
        cameras[int(camera_id)] = Camera(model, int(width), int(height), tuple(map(float, params)))

    rows = [line.split() for line in _lines(folder / "points3D.txt")]
    point_ids, positions, residuals, dropped = _sorted_points(
        [int(row[0]) for row in rows],
        [tuple(map(float, row[1:4])) for row in rows],
        [float(row[7]) for row in rows],
    )

    images: dict[int, ModelImage] = {}
    lines = _lines(folder / "images.txt", keep_empty=True)
    for line in lines:
        if not line:
            continue
        image_id, *pose, camera_id, name = line.split(maxsplit=9)
        points2d = np.array(next(lines, "").split(), np.float64).reshape(-1, 3)
        images[int(image_id)] = _model_image(
            name,
            int(camera_id),
            _pose(name, [float(value) for value in pose]),
            points2d[:, :2],
            points2d[:, 2].astype(np.int64),
            point_ids,
        )
    return SparseModel(cameras, images, point_ids, positions, residuals, dropped)


def _lines(path: Path, *, keep_empty: bool = False) -> Iterator[str]:
    for line in read_text(path).splitlines():
        stripped = line.strip()
        if not stripped.startswith("#") and (stripped or keep_empty):
            yield stripped


def _pose(name: str, values: list[int | float] | list[float]) -> Pose:
    numbers = np.array(values, np.float64)
    if not within_reach(numbers) or not 1e-6 < np.abs(numbers[:4]).max() < 1e6:
        raise ValueError(f"the pose of {name} is not finite, or out of reach")
    return Pose.from_quaternion(numbers[:4], numbers[4:])


def _sorted_points(
    ids: list[int], xyz: list[tuple[float, ...]], errors: list[float]
) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64], int]:
    """Ids, positions and errors of the points that can be used, by id; how many cannot."""
    point_ids = np.array(ids, np.int64)
    positions, residuals = np.array(xyz, np.float64).reshape(-1, 3), np.array(errors, np.float64)
    order = np.argsort(point_ids)
    if (np.diff(point_ids[order]) == 0).any():
        raise ValueError("a point id is there twice")
    usable = order[(np.isfinite(positions).all(axis=1) & np.isfinite(residuals))[order]]
    return point_ids[usable], positions[usable], residuals[usable], len(ids) - len(usable)
