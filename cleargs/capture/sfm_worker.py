"""The COLMAP side of ingest: ``python -m cleargs.capture.sfm_worker job.json``, run by `cleargs.capture.sfm`.

Reads its job from JSON, works in ``job["folder"]`` and leaves a binary model in ``folder/model``. What a
killed run left in the database (features, matches) is used again.

Equal for any number of threads: ids are given in frame order before any thread starts, every random choice is
seeded, and mapping and triangulation (whose least squares sum in thread order) run on one thread.
"""

from __future__ import annotations

import copy
import filecmp
import json
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cleargs.capture.child import ChildChannel
from cleargs.capture.colmap import pycolmap
from cleargs.capture.pairs import exhaustive_pairs, loop_pairs, sequential_pairs
from cleargs.files import make_folder, sync, sync_tree

_PAIRS_PER_BLOCK = 100
_REFINEMENTS = 4
_CONVINCING = 0.5
"""Adjusted poses are taken where features then miss their points by at most this share of before. What was
left on measured captures: 0.05 with random errors of poses, 0.34 and 0.41 with the poses of a depth camera
and of a headset, but 0.77 with a rolling shutter and all with blur, which other poses do not explain."""
_HELD_BY = 15
"""Fewest points that a frame must see to take part in an adjustment."""


def main() -> int:
    """Do the job; the exit code is 3 when it failed with a reason that was reported."""
    channel = ChildChannel.open()
    job = json.loads(Path(sys.argv[1]).read_text(encoding="utf-8"))
    pycolmap.set_random_seed(job["seed"])
    folder = Path(job["folder"])
    database = folder / "database.db"
    _import(job, database)
    _extract(job, database, channel)
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
    _match(job, database, channel)
    partial = folder / "model.partial"
    make_folder(partial, empty=True)
    if job["poses"] is None:
        model = _map(job, database, partial, channel)
    else:
        model = _triangulate(job, database, partial, channel)
        missed, refined = _median_error(model), False
        if missed > job["refine_above"]:
            adjusted = _refine(job, database, copy.deepcopy(model), partial, channel)
            if refined := _median_error(adjusted) <= _CONVINCING * missed:
                model = adjusted
    if model is None:
        channel.error(
            "no two frames could be matched well enough to start a reconstruction",
            "record more frames with more overlap and texture, and move the camera rather than turn it",
        )
        return 3
    make_folder(partial, empty=True)
    model.write_binary(partial)
    if job["poses"] is not None:
        said = {"missed_px": missed, "refined": refined}
        (partial / "given_poses.json").write_text(json.dumps(said), encoding="utf-8")
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
    if job["exif_image"] is not None:
        apply_exif_focal(cameras, Path(job["exif_image"]))
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


def apply_exif_focal(cameras: Sequence[pycolmap.Camera], image: Path) -> None:
    """Start from the focal length that the input's first image states, where it does."""
    try:
        stated = pycolmap.infer_camera_from_image(image)
    except ValueError:  # a format that COLMAP does not read (it gets PNG copies): no EXIF either
        return
    if not stated.has_prior_focal_length:
        return
    factor = stated.mean_focal_length() / max(stated.width, stated.height)
    for camera in cameras:
        params = list(camera.params)
        for index in camera.focal_length_idxs():
            params[index] = factor * max(camera.width, camera.height)
        camera.params = params
        camera.has_prior_focal_length = True


def _extract(job: dict[str, Any], database: Path, channel: ChildChannel) -> None:
    """SIFT on the working images; frames that have features already are skipped by COLMAP."""
    options = pycolmap.FeatureExtractionOptions(num_threads=job["threads"], use_gpu=False)
    options.sift.max_num_features = job["max_features"]
    reader = pycolmap.ImageReaderOptions()
    if job["masks"] is not None:
        reader.mask_path = job["masks"]
    names: list[str] = job["names"]
    channel.phase("finding features", len(names))
    for start, block in _blocks(names, 4 * job["threads"]):
        pycolmap.extract_features(
            database, job["images"], image_names=block, reader_options=reader, extraction_options=options
        )
        channel.done(start + len(block))


def _match(job: dict[str, Any], database: Path, channel: ChildChannel) -> None:
    """Match and verify the pairs of `_pairs`; pairs that were matched before are skipped by COLMAP."""
    matching = pycolmap.FeatureMatchingOptions(num_threads=job["threads"], use_gpu=False)
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = job["seed"]
    pairing = pycolmap.ImportedPairingOptions(match_list_path=database.with_name("pairs.txt"))
    names: list[str] = job["names"]
    pairs = _pairs(job, database, channel)
    channel.phase("matching", len(pairs))
    for start, block in _blocks(pairs, _PAIRS_PER_BLOCK):
        lines = (f"{names[i]} {names[j]}\n" for i, j in block)
        Path(pairing.match_list_path).write_text("".join(lines), encoding="utf-8")
        pycolmap.match_image_pairs(database, matching, pairing, verification)
        channel.done(start + len(block))


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
    # Fewer than COLMAP's ten: a capture of a dozen frames may register eight, and that is a model.
    options.min_model_size = 3
    options.max_num_models = 5
    total = len(job["names"])
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
            if pose is None:
                continue
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
) -> pycolmap.Reconstruction:
    """Adjust poses and points to the features; the cameras stay.

    At better poses more features find their points, so both are done in turn. The features leave place, turn
    and size of the whole open: the adjusted cameras are laid over the given ones by a similarity. A frame
    that few points hold keeps its given pose.
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
