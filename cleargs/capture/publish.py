"""From working images and a sparse model to the folder that later stages read."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from cleargs.capture.cameras import Camera, guessed_camera
from cleargs.capture.model import ModelImage, SparseModel, write_model
from cleargs.capture.prepare import WorkFrame, resumable
from cleargs.capture.tables import FRAMES, OBSERVATIONS, POINTS
from cleargs.capture.undistort import Undistorter, undistorter
from cleargs.errors import StageError
from cleargs.files import make_folder, remove
from cleargs.media.image import read_mask, read_rgb, write_mask, write_rgb
from cleargs.parquet import write_table
from cleargs.progress import Reporter


@dataclass(frozen=True)
class _View:
    """A published frame."""

    frame: WorkFrame
    camera: Camera
    image: ModelImage | None
    """Observations in pixels of the published image; None when unregistered."""
    placed: str
    """How the pose was found, or why there is none."""


def publish(
    frames: Sequence[WorkFrame],
    model: SparseModel,
    placed: Mapping[str, str],
    test: set[int],
    work: Path,
    out: Path,
    max_size: int,
    reporter: Reporter,
) -> SparseModel:
    """Write images, masks, the three tables and the COLMAP model of the undistorted capture into ``out``.

    ``placed`` says of every working image how its pose was found, or why there is none.
    Points take their colour from train frames; a point that no train frame shows (or fewer than two frames in
    all, after undistortion cropped them) is left out. Returns the published model.
    """
    make_folder(out / "images")
    remove(out / "masks")  # written anew, and without any the folder says that no frame has one
    if any(frame.masked for frame in frames):
        make_folder(out / "masks")
    ours = {frame.image for frame in frames}
    for file in (out / "images").iterdir():
        if file.name not in ours:
            remove(file)
    views: list[_View] = []
    sums = np.zeros((len(model.point_ids), 3))
    samples = np.zeros(len(model.point_ids), np.int64)
    undistorters: dict[Camera, Undistorter] = {}
    cameras = _cameras(frames, model)
    registered = {image.name: image for image in model.images.values()}
    with reporter.task("undistorting", len(frames)) as task:
        for index, frame in enumerate(frames):
            lens = cameras[index]
            if lens not in undistorters:
                undistorters[lens] = undistorter(lens, max_size)
            undistortion = undistorters[lens]
            rgb = _write_picture(frame, undistortion, work, out, reporter)
            image = registered.get(frame.image)
            if image is not None:
                image = _flattened(image, undistortion)
                if index not in test:
                    rows = np.searchsorted(model.point_ids, image.point_ids)
                    x, y = image.xy.astype(np.int64).T
                    sums[rows] += rgb[y, x]
                    samples[rows] += 1
            views.append(_View(frame, undistortion.pinhole, image, placed[frame.image]))
            task.advance()
    counts = _track_lengths(views, model.point_ids)
    kept = (counts >= 2) & (samples >= 1)
    if not kept.any():
        raise StageError(
            "no sparse point is seen by two frames",
            hint="record with more texture and overlap between frames",
        )
    rgb_mean = np.rint(sums[kept] / samples[kept, None]).astype(np.uint8)
    published = _with_views(model, views).kept(kept)
    _write_tables(out, views, test, published, rgb_mean, counts[kept])
    write_model(out / "colmap" / "sparse" / "0", published, rgb_mean)
    return published


def _cameras(frames: Sequence[WorkFrame], model: SparseModel) -> list[Camera]:
    """The camera of each frame; an unregistered one takes its own, else the commonest of its size."""
    found: list[Camera | None] = []
    by_name = {image.name: model.cameras[image.camera_id] for image in model.images.values()}
    for frame in frames:
        found.append(by_name.get(frame.image, frame.camera))
    common: dict[tuple[int, int], Counter[Camera]] = {}
    for camera in found:
        if camera is not None:
            common.setdefault((camera.width, camera.height), Counter())[camera] += 1
    cameras = []
    for frame, camera in zip(frames, found, strict=True):
        if camera is None:
            alike = common.get((frame.width, frame.height))
            camera = (
                alike.most_common(1)[0][0] if alike else guessed_camera("PINHOLE", frame.width, frame.height)
            )
        cameras.append(camera)
    return cameras


def _write_picture(
    frame: WorkFrame, undistortion: Undistorter, work: Path, out: Path, reporter: Reporter
) -> NDArray[np.uint8]:
    """Undistort image and mask of a frame (a killed run may have done so) and return the image."""
    target = out / "images" / frame.image
    if resumable(target, reporter):
        rgb = read_rgb(target)
    else:
        rgb = undistortion.image(read_rgb(work / "images" / frame.image))
        write_rgb(target, rgb)
    if frame.masked:
        write_mask(
            out / "masks" / frame.image, undistortion.mask(read_mask(work / "masks" / f"{frame.image}.png"))
        )
    return rgb


def _flattened(image: ModelImage, undistortion: Undistorter) -> ModelImage:
    """The observations in the published image; those in the cropped margin are gone."""
    xy = undistortion.points(image.xy)
    return replace(image, xy=xy).kept(undistortion.inside(xy))


def _track_lengths(views: Sequence[_View], point_ids: NDArray[np.int64]) -> NDArray[np.int32]:
    counts = np.zeros(len(point_ids), np.int32)
    for view in views:
        if view.image is not None:
            counts[np.searchsorted(point_ids, view.image.point_ids)] += 1
    return counts


def _with_views(model: SparseModel, views: Sequence[_View]) -> SparseModel:
    """``model`` with the registered views as its images: image id = frame_id + 1, an id a distinct camera."""
    ids: dict[Camera, int] = {}
    images = {}
    for index, view in enumerate(views):
        if view.image is not None:
            camera_id = ids.setdefault(view.camera, len(ids) + 1)
            images[index + 1] = replace(view.image, camera_id=camera_id)
    cameras = {camera_id: camera for camera, camera_id in ids.items()}
    return replace(model, cameras=cameras, images=images)


def _write_tables(
    out: Path,
    views: Sequence[_View],
    test: set[int],
    model: SparseModel,
    rgb: NDArray[np.uint8],
    track_length: NDArray[np.int32],
) -> None:
    rows = [
        _frame_row(index, view, model.images.get(index + 1), "test" if index in test else "train")
        for index, view in enumerate(views)
    ]
    write_table(out / "frames.parquet", pa.Table.from_pylist(rows, FRAMES), FRAMES)
    points = {
        "point_id": model.point_ids,
        **{name: model.xyz[:, axis] for axis, name in enumerate("xyz")},
        **{name: rgb[:, channel] for channel, name in enumerate("rgb")},
        "error": model.error,
        "track_length": track_length,
    }
    write_table(out / "points.parquet", pa.table(points, POINTS), POINTS)
    seen = [(key - 1, np.sort(image.point_ids)) for key, image in model.images.items()]
    observations = {
        "frame_id": np.concatenate([np.full(len(ids), index, np.int32) for index, ids in seen]),
        "point_id": np.concatenate([ids for _, ids in seen]),
    }
    write_table(out / "observations.parquet", pa.table(observations, OBSERVATIONS), OBSERVATIONS)


def _frame_row(index: int, view: _View, image: ModelImage | None, split: str) -> dict[str, object]:
    (fx, fy), (cx, cy) = view.camera.focal, view.camera.centre
    row: dict[str, object] = {
        "frame_id": index,
        "name": view.frame.source.name,
        "image": f"images/{view.frame.image}",
        "time_s": view.frame.source.time_s,
        "width": view.camera.width,
        "height": view.camera.height,
        "fx": fx,
        "fy": fy,
        "cx": cx,
        "cy": cy,
        "registered": image is not None,
        "n_points": 0 if image is None else len(image.point_ids),
        "split": split,
        "placed": view.placed,
    }
    if image is not None:
        pose = image.pose
        row.update(zip(("qw", "qx", "qy", "qz"), pose.quaternion, strict=True))
        row.update(zip(("tx", "ty", "tz"), pose.translation.tolist(), strict=True))
    return row
