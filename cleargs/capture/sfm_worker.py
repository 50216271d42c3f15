"""The COLMAP side of ingest: ``python -m cleargs.capture.sfm_worker job.json``, run by `cleargs.capture.sfm`.

Reads its job from JSON, works in ``job["folder"]`` and leaves a binary model in ``folder/model``. What a
killed run left in the database (features, matches) is used again. Frames that mapping leaves out are tried a
second time at half resolution.

Equal for any number of threads: ids are given in frame order before any thread starts, every random choice is
seeded, frames are matched by processes, and mapping and triangulation (whose least squares sum in thread
order) run on one thread.
"""

from __future__ import annotations

import copy
import filecmp
import json
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cleargs.capture.child import ChildChannel
from cleargs.capture.colmap import pycolmap
from cleargs.capture.matching import (
    copy_without_features,
    exhaustive_pairs,
    loop_pairs,
    match_pairs,
    sequential_pairs,
    why_missing,
)
from cleargs.files import make_folder, sync, sync_tree

_MIN_MODEL = 10
"""COLMAP's fewest frames of a model: a smaller one is thrown away and begun elsewhere. In a short capture, a
third of its frames: eight of a dozen are a model."""
_REFINEMENTS = 4
_CONVINCING = 0.5
"""Adjusted poses are taken where features then miss their points by at most this share of before. What was
left on measured captures: 0.05 with random errors of poses, 0.34 and 0.41 with the poses of a depth camera
and of a headset, but 0.77 with a rolling shutter and all with blur, which other poses do not explain."""
_HELD_BY = 15
"""Fewest points that a frame must see to take part in an adjustment."""


@dataclass(frozen=True)
class _Effort:
    """How features are found and matched, and when a frame counts as placed by them."""

    reduced: int
    """The images are reduced to one over this, if any is as large as the largest."""
    contrast: float
    inliers: int
    """Fewest points of the model that must fit the pose of a frame."""
    again: str = ""


_FIRST = _Effort(reduced=1, contrast=0.02 / 3, inliers=30)
"""COLMAP's defaults."""
_SECOND = _Effort(reduced=2, contrast=0.002, inliers=15, again=" again")
"""For frames with a blur of 24 px at 480: at half the size it is half as long, and what contrast it left is
enough (docs/experiments/poses.md)."""


def main() -> int:
    """Do the job; the exit code is 3 when it failed with a reason that was reported."""
    channel = ChildChannel.open()
    job = json.loads(Path(sys.argv[1]).read_text(encoding="utf-8"))
    pycolmap.set_random_seed(job["seed"])
    folder = Path(job["folder"])
    database = folder / "database.db"
    _import(job, database)
    _extract(job, database, job["names"], _FIRST, channel)
    with pycolmap.Database.open(database) as opened:
        featureless = opened.num_keypoints() == 0
    if featureless:
        channel.error(
            "no features were found in any frame",
            "the frames need texture and light, and masks must leave some of them",
        )
        return 3
    first, *others = (Path(job["images"]) / name for name in job["names"])
    if all(filecmp.cmp(first, other, shallow=False) for other in others):
        channel.error(
            f"all {len(job['names'])} frames show the same picture",
            "the camera must move while it records; look whether the video froze",
        )
        return 3
    pairs = _pairs(job, database, channel)
    _match(job, database, pairs, _FIRST, channel)
    partial = folder / "model.partial"
    make_folder(partial, empty=True)
    placed: dict[str, str] = {}
    missed, refined = None, False
    if job["poses"] is None:
        model = _map(job, database, partial, channel)
        if model is not None:
            model, placed = _place_the_rest(job, database, pairs, model, partial, channel)
    else:
        model = _triangulate(job, database, partial, channel)
        missed = _median_error(model)
        if missed > job["refine_above"]:
            adjusted = _refine(job, database, copy.deepcopy(model), partial, channel)
            if adjusted is not None and _median_error(adjusted) <= _CONVINCING * missed:
                model, refined = adjusted, True
    if model is None:
        channel.error(
            "no two frames could be matched well enough to start a reconstruction",
            "record more frames with more overlap and texture, and move the camera rather than turn it",
        )
        return 3
    make_folder(partial, empty=True)
    model.write_binary(partial)
    outcome = {"placed": placed, "missed_px": missed, "refined": refined}
    (partial / "outcome.json").write_text(json.dumps(outcome), encoding="utf-8")
    sync_tree(partial)
    partial.rename(folder / "model")
    sync(folder)
    return 0


def _import(job: dict[str, Any], database: Path) -> None:
    """Create the database with cameras and images in frame order, so that ids do not depend on threads."""
    names: list[str] = job["names"]
    if database.exists():
        with pycolmap.Database.open(database) as opened:
            whole = opened.num_images() == len(names)
        if whole:
            return
        for leftover in database.parent.glob("database.db*"):
            leftover.unlink()
    cameras = [pycolmap.Camera(**camera) for camera in job["cameras"]]
    for camera, image in zip(cameras, job["exif_images"], strict=True):
        if image is not None:
            apply_exif_focal(camera, Path(image))
    with pycolmap.Database.open(database) as opened, pycolmap.DatabaseTransaction(opened):
        for index, camera in enumerate(cameras):
            camera.camera_id = index + 1
            opened.write_camera(camera, use_camera_id=True)
            rig = pycolmap.Rig(rig_id=index + 1)
            rig.add_ref_sensor(camera.sensor_id)
            opened.write_rig(rig, use_rig_id=True)
        for index, (name, camera) in enumerate(zip(names, job["camera_of"], strict=True)):
            image = pycolmap.Image(name=name, camera_id=camera + 1, image_id=index + 1)
            opened.write_image(image, use_image_id=True)
            frame = pycolmap.Frame(frame_id=index + 1, rig_id=camera + 1)
            frame.add_data_id(image.data_id)
            opened.write_frame(frame, use_frame_id=True)


def apply_exif_focal(camera: pycolmap.Camera, image: Path) -> None:
    """Start from the focal length that an input image of the camera states, where it does."""
    try:
        stated = pycolmap.infer_camera_from_image(image)
    except ValueError:  # a format that COLMAP does not read (it gets PNG copies): no EXIF either
        return
    if not stated.has_prior_focal_length:
        return
    factor = stated.mean_focal_length() / max(stated.width, stated.height)
    params = list(camera.params)
    for index in camera.focal_length_idxs():
        params[index] = factor * max(camera.width, camera.height)
    camera.params = params
    camera.has_prior_focal_length = True


def _extract(
    job: dict[str, Any], database: Path, names: Sequence[str], effort: _Effort, channel: ChildChannel
) -> None:
    """SIFT on the working images; frames that have features already are skipped by COLMAP."""
    options = pycolmap.FeatureExtractionOptions(num_threads=job["threads"], use_gpu=False)
    largest = max(max(camera["width"], camera["height"]) for camera in job["cameras"])
    options.max_image_size = largest // effort.reduced
    options.sift.max_num_features = job["max_features"]
    options.sift.peak_threshold = effort.contrast
    reader = pycolmap.ImageReaderOptions()
    if job["masks"] is not None:
        reader.mask_path = job["masks"]
    channel.phase(f"finding features{effort.again}", len(names))
    for start, block in _blocks(names, 4 * job["threads"]):
        pycolmap.extract_features(
            database, job["images"], image_names=block, reader_options=reader, extraction_options=options
        )
        channel.done(start + len(block))


def _match(
    job: dict[str, Any],
    database: Path,
    pairs: Sequence[tuple[int, int]],
    effort: _Effort,
    channel: ChildChannel,
) -> None:
    """Match and verify pairs of frames; pairs that were matched before are skipped."""
    channel.phase(f"matching{effort.again}", len(pairs))
    match_pairs(database, job["names"], pairs, job["seed"], job["threads"], channel.done)


def _pairs(job: dict[str, Any], database: Path, channel: ChildChannel) -> list[tuple[int, int]]:
    count = len(job["names"])
    if count < job["exhaustive_below"]:
        return exhaustive_pairs(count)
    near = sequential_pairs(count, job["overlap"])
    if not job["loop_candidates"]:
        return near
    channel.phase("looking for loops", None)
    with pycolmap.Database.open(database) as opened:
        descriptors = [np.asarray(opened.read_descriptors(index + 1).data) for index in range(count)]
    loops = loop_pairs(descriptors, job["loop_candidates"], 2 * job["overlap"], job["seed"])
    return sorted({*near, *loops})


def _map(
    job: dict[str, Any], database: Path, output: Path, channel: ChildChannel
) -> pycolmap.Reconstruction | None:
    """Incremental mapping; the model with the most registered frames (the first of equals), or None."""
    options = _pipeline_options(job)
    total = len(job["names"])
    options.min_model_size = min(_MIN_MODEL, max(3, total // 3))
    options.max_num_models = 5
    # COLMAP's 1.1 adjusts the whole model after every tenth frame more: half as much again, equal errors.
    options.ba_global_frames_ratio = options.ba_global_points_ratio = 1.4
    channel.phase("reconstructing", total)
    registered = 0

    def started() -> None:
        nonlocal registered
        registered = 2
        channel.done(registered)

    def registered_next() -> None:
        nonlocal registered
        registered = min(registered + 1, total)
        channel.done(registered)

    models = pycolmap.incremental_mapping(
        database,
        job["images"],
        output,
        options,
        initial_image_pair_callback=started,
        next_image_callback=registered_next,
    )
    return max(models.values(), key=lambda model: model.num_reg_images(), default=None)


def _place_the_rest(
    job: dict[str, Any],
    database: Path,
    pairs: Sequence[tuple[int, int]],
    model: pycolmap.Reconstruction,
    output: Path,
    channel: ChildChannel,
) -> tuple[pycolmap.Reconstruction, dict[str, str]]:
    """Go on mapping with the features of the frames without a pose found anew by `_SECOND`; how each frame
    was placed, or why it was not.

    Works in a copy of the database: a killed run finds the first as it was.
    """
    names: list[str] = job["names"]
    first = {image.name for image in model.images.values()}
    missing = {index for index, name in enumerate(names) if name not in first}
    if not missing:
        return model, dict.fromkeys(names, "sfm")
    copy = database.with_name("second.db")
    copy_without_features(database, copy, [index + 1 for index in sorted(missing)])
    _extract(job, copy, [names[index] for index in sorted(missing)], _SECOND, channel)
    _match(job, copy, [pair for pair in pairs if not missing.isdisjoint(pair)], _SECOND, channel)
    channel.phase("placing frames again", None)
    options = _pipeline_options(job)
    options.multiple_models = False
    options.mapper.abs_pose_min_num_inliers = _SECOND.inliers
    make_folder(output / "first")
    model.write_binary(output / "first")
    models = pycolmap.incremental_mapping(copy, job["images"], output, options, input_path=output / "first")
    model = max([model, *models.values()], key=lambda model: model.num_reg_images())
    placed = {image.name for image in model.images.values()}
    reasons = why_missing(copy, [index + 1 for index, name in enumerate(names) if name not in placed])
    return model, {
        name: reasons[index + 1]
        if name not in placed
        else "sfm"
        if name in first
        else "sfm at half resolution"
        for index, name in enumerate(names)
    }


def _triangulate(
    job: dict[str, Any], database: Path, output: Path, channel: ChildChannel
) -> pycolmap.Reconstruction:
    """Points at the given poses and cameras, which stay as they are here."""
    channel.phase("triangulating", None)
    model = pycolmap.Reconstruction()
    with pycolmap.Database.open(database) as opened:
        for camera in opened.read_all_cameras():
            model.add_camera_with_trivial_rig(camera)
        for image in sorted(opened.read_all_images(), key=lambda image: image.image_id):
            pose = job["poses"][image.image_id - 1]
            world_to_camera = pycolmap.Rigid3d(np.array(pose))
            model.add_image_with_trivial_frame(
                pycolmap.Image(name=image.name, camera_id=image.camera_id, image_id=image.image_id),
                world_to_camera,
            )
    return pycolmap.triangulate_points(model, database, job["images"], output, options=_pipeline_options(job))


def _median_error(model: pycolmap.Reconstruction) -> float:
    """Median over the points of their mean reprojection error, px; 0 without any point."""
    errors = [point.error for point in model.points3D.values()]
    return float(np.median(errors)) if errors else 0.0


def _refine(
    job: dict[str, Any], database: Path, model: pycolmap.Reconstruction, output: Path, channel: ChildChannel
) -> pycolmap.Reconstruction | None:
    """Adjust poses and points to the features; the cameras stay.

    At better poses more features find their points, so both are done in turn. The features leave place, turn
    and size of the whole open: the adjusted cameras are laid over the given ones by a similarity. A frame
    that few points hold keeps its given pose. None where few points hold every frame.
    """
    given = {
        frame_id: pycolmap.Rigid3d(frame.rig_from_world.matrix()) for frame_id, frame in model.frames.items()
    }
    before = {image.name: _centre_and_axes(image) for image in model.images.values()}
    channel.phase("adjusting poses", _REFINEMENTS)
    for done in range(_REFINEMENTS):
        pycolmap.bundle_adjustment(model, _adjustment_options())
        model = pycolmap.triangulate_points(
            model, database, job["images"], output, options=_pipeline_options(job)
        )
        channel.done(done + 1)
    held = [image for image in model.images.values() if image.num_points3D >= _HELD_BY]
    if not held:
        return None
    similarity = pycolmap.estimate_sim3d(
        np.array([_centre_and_axes(image) for image in held]).reshape(-1, 3),
        np.array([before[image.name] for image in held]).reshape(-1, 3),
    )
    if similarity is not None:
        model.transform(similarity)
    for image in model.images.values():
        if image.num_points3D < _HELD_BY:
            model.frames[image.frame_id].rig_from_world = given[image.frame_id]
    return model


def _centre_and_axes(image: pycolmap.Image) -> NDArray[np.float64]:  # [4, 3]
    """Where a camera is, and the points at distance 1 on its axes: the centres of a straight path alone leave
    the turn about it open. (1 is the distance of the farthest camera in the normalised world.)"""
    centre: NDArray[np.float64] = image.projection_center()
    return np.vstack([centre, centre + image.cam_from_world().rotation.matrix()])


def _adjustment_options() -> pycolmap.BundleAdjustmentOptions:
    options = pycolmap.BundleAdjustmentOptions(
        refine_focal_length=False, refine_extra_params=False, print_summary=False
    )
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY  # wrong matches are still among them
    options.ceres.solver_options.num_threads = 1
    return options


def _pipeline_options(job: dict[str, Any]) -> pycolmap.IncrementalPipelineOptions:
    options = pycolmap.IncrementalPipelineOptions(
        num_threads=1, random_seed=job["seed"], extract_colors=False
    )
    options.mapper.num_threads = 1
    options.mapper.random_seed = job["seed"]
    options.triangulation.random_seed = job["seed"]
    return options


def _blocks(items: Sequence[Any], size: int) -> Iterator[tuple[int, list[Any]]]:
    for start in range(0, len(items), size):
        yield start, list(items[start : start + size])


if __name__ == "__main__":
    sys.exit(main())
