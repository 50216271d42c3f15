"""From working images and a sparse model to the folder that later stages read."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from cleargs.capture.cameras import Intrinsics, guessed_camera
from cleargs.capture.cutouts import resampled, write_cut_out
from cleargs.capture.loose_points import LoosePoints
from cleargs.capture.model import ModelImage, SparseModel, write_model
from cleargs.capture.prepare import WorkFrame
from cleargs.capture.sfm_job import Prediction, SfmOutcome
from cleargs.capture.tables import FRAMES, MOVERS, OBSERVATIONS, POINTS
from cleargs.capture.undistort import undistorter
from cleargs.errors import StageError
from cleargs.files import make_folder, remove
from cleargs.media.image import read_grey, read_mask, read_rgb, write_mask, write_rgb
from cleargs.parquet import write_table
from cleargs.progress import Reporter


def publish(
    frames: Sequence[WorkFrame],
    model: SparseModel,
    outcome: SfmOutcome,
    test: set[int],
    work: Path,
    out: Path,
    max_size: int,
    reporter: Reporter,
    loose: LoosePoints | None = None,
) -> SparseModel:
    """Write images, masks, the three tables and the COLMAP model of the undistorted capture into ``out``.

    The colours of points are from train frames. Points are left out if no train frame shows them, or if fewer
    than two frames show them after undistortion cropped the images. Returns the published model. ``model`` is
    that of the working images in ``work``, ``outcome`` says how the pose of each was found or why there is
    none, and ``test`` are the numbers of the test frames. The table of points ends with the ``loose`` ones.
    """
    make_folder(out / "images", empty=True)
    remove(out / "masks")  # without the folder, no frame has a mask
    remove(out / "movers.parquet")
    if any(frame.masked for frame in frames):
        make_folder(out / "masks")
    flat: list[Intrinsics] = []
    numbers: dict[Intrinsics, int] = {}
    images: dict[int, ModelImage] = {}
    movers: list[dict[str, int]] = []
    sums = np.zeros((len(model.point_ids), 3))
    samples = np.zeros(len(model.point_ids), np.int64)
    lenses = _cameras(frames, model)
    undistorters = {lens: undistorter(lens, max_size) for lens in dict.fromkeys(lenses)}
    registered = {image.name: image for image in model.images.values()}
    with reporter.task("undistorting", len(frames)) as task:
        for index, (frame, lens) in enumerate(zip(frames, lenses, strict=True)):
            undistortion = undistorters[lens]
            flat.append(undistortion.pinhole)
            rgb = read_rgb(work / "images" / frame.image)
            if frame.cut_out:
                alpha = read_grey(work / "alphas" / frame.image)
                rgb, alpha = resampled(rgb, alpha, undistortion.image)
                if frame.source.mask is not None:  # ignored pixels are not empty
                    ignored = undistortion.mask(read_mask(work / "masks" / f"{frame.image}.png")) == 0
                    alpha = np.where(ignored, np.uint8(255), alpha)
                write_cut_out(out / "images" / frame.image, rgb, alpha)
            else:
                rgb = undistortion.image(rgb)
                write_rgb(out / "images" / frame.image, rgb)
            if frame.masked:
                mask = read_mask(work / "masks" / f"{frame.image}.png")
                write_mask(out / "masks" / frame.image, undistortion.mask(mask))
            movers += [{"frame_id": index, **undistortion.box(corners)} for corners in frame.movers or ()]
            if frame.image in registered:
                xy = undistortion.points(registered[frame.image].xy)
                image = replace(registered[frame.image], xy=xy).select(undistortion.inside(xy))
                if index not in test:
                    rows = np.searchsorted(model.point_ids, image.point_ids)
                    x, y = image.xy.astype(np.int64).T
                    sums[rows] += rgb[y, x]
                    samples[rows] += 1
                number = numbers.setdefault(undistortion.pinhole, len(numbers) + 1)
                images[index + 1] = replace(image, camera_id=number)
            task.advance()
    seen = np.concatenate([image.point_ids for image in images.values()])
    counts = np.bincount(np.searchsorted(model.point_ids, seen), minlength=len(model.point_ids))
    kept = (counts >= 2) & (samples >= 1)
    if not kept.any():
        hint = "record with more texture and overlap between frames"
        raise StageError("no sparse point is seen by two frames", hint=hint)
    rgb_mean = np.rint(sums[kept] / samples[kept, None]).astype(np.uint8)
    cameras = {number: camera for camera, number in numbers.items()}
    published = replace(model, cameras=cameras, images=images).select(kept)
    table = [
        {
            "frame_id": index,
            "split": "test" if index in test else "train",
            "placed": outcome.placed[frame.image],
            **_kept_out(outcome.predictions.get(frame.image)),
            **_frame_row(frame, camera, published.images.get(index + 1)),
        }
        for index, (frame, camera) in enumerate(zip(frames, flat, strict=True))
    ]
    write_table(out / "frames.parquet", pa.Table.from_pylist(table, FRAMES), FRAMES)
    if any(frame.movers is not None for frame in frames):
        write_table(out / "movers.parquet", pa.Table.from_pylist(movers, MOVERS), MOVERS)
    _write_points(out, published, rgb_mean, counts[kept].astype(np.int32), loose)
    write_model(out / "colmap" / "sparse" / "0", published, rgb_mean)
    return published


def _cameras(frames: Sequence[WorkFrame], model: SparseModel) -> list[Intrinsics]:
    """Return the camera of each frame; an unregistered one has its own, or the most frequent of its size."""
    by_name = {image.name: model.cameras[image.camera_id] for image in model.images.values()}
    found = [by_name.get(frame.image, frame.camera) for frame in frames]
    common = Counter(camera for camera in found if camera is not None).most_common()
    cameras = []
    for frame, camera in zip(frames, found, strict=True):
        size = (frame.width, frame.height)
        alike = (other for other, _ in common if (other.width, other.height) == size)
        cameras.append(camera or next(alike, None) or guessed_camera("PINHOLE", *size))
    return cameras


def _write_points(
    out: Path,
    model: SparseModel,
    rgb: NDArray[np.uint8],
    track_length: NDArray[np.int32],
    loose: LoosePoints | None,
) -> None:
    points = {
        "point_id": model.point_ids,
        **{name: model.xyz[:, axis] for axis, name in enumerate("xyz")},
        **{name: rgb[:, channel] for channel, name in enumerate("rgb")},
        "error": model.error,
        "track_length": track_length,
    }
    if loose is not None:
        count = len(loose.xyz)
        ids = int(model.point_ids.max()) + 1 + np.arange(count)
        more = (ids, *loose.xyz.T, *loose.rgb.T, np.zeros(count), np.zeros(count, np.int32))
        points = {
            name: np.concatenate(both) for name, *both in zip(points, points.values(), more, strict=True)
        }
    write_table(out / "points.parquet", pa.table(points, POINTS), POINTS)
    seen = [(key - 1, np.sort(image.point_ids)) for key, image in model.images.items()]
    observations = {
        "frame_id": np.concatenate([np.full(len(ids), index, np.int32) for index, ids in seen]),
        "point_id": np.concatenate([ids for _, ids in seen]),
    }
    write_table(out / "observations.parquet", pa.table(observations, OBSERVATIONS), OBSERVATIONS)


def _kept_out(found: Prediction | None) -> dict[str, object]:
    return {
        "kept_out_keypoints": found and found.keypoints,
        "kept_out_share": found and found.share,
        "kept_out_px": found and found.median_px,
    }


def _frame_row(frame: WorkFrame, camera: Intrinsics, image: ModelImage | None) -> dict[str, object]:
    pose = [] if image is None else [*image.pose.quaternion, *image.pose.translation.tolist()]
    return {
        "name": frame.source.name,
        "image": f"images/{frame.image}",
        "time_s": frame.source.time_s,
        "width": camera.width,
        "height": camera.height,
        **dict(zip(("fx", "fy", "cx", "cy"), (*camera.focal, *camera.centre), strict=True)),
        **dict(zip(("qw", "qx", "qy", "qz", "tx", "ty", "tz"), pose, strict=False)),
        "registered": image is not None,
        "n_points": 0 if image is None else len(image.point_ids),
    }
