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
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import combinations, count
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from cleargs.base_model import FrozenModel
from cleargs.capture.cameras import Intrinsics
from cleargs.capture.child import reports_to_parent
from cleargs.capture.colmap import pycolmap
from cleargs.capture.config import SfmConfig
from cleargs.capture.matching import (
    copy_without_features,
    loop_pairs,
    match_pairs,
    remove_database,
    sequential_pairs,
    why_missing,
)
from cleargs.errors import StageError
from cleargs.files import make_folder, sync, sync_tree, write_json
from cleargs.safe_io import read_json

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


OUTCOME = "outcome.json"
"""In the folder of the model: its `SfmOutcome`."""


class Job(FrozenModel):
    """What COLMAP gets: working images, their cameras, the poses if they are known, and settings."""

    folder: Path
    images: Path
    masks: Path | None
    names: list[str]
    cameras: list[Intrinsics]
    camera_of: list[int]
    """For each image the number of its camera."""
    poses: list[list[list[float]]] | None
    """World to camera, 3x4 for each image."""
    exif_images: list[Path | None]
    """For each camera an input image that may state its focal length."""
    config: SfmConfig
    seed: int
    threads: int


class SfmOutcome(FrozenModel):
    """Origin of a model."""

    placed: Mapping[str, str] = Field(default_factory=dict)
    """Working image -> how its pose was found, or why there is none; COLMAP's process knows it of SfM."""
    missed_px: float | None = None
    """Median reprojection error at the input's poses, px of the working images; None: it brought no poses."""
    refined: bool = False
    """Whether they were adjusted."""


@dataclass(frozen=True)
class _FeatureSettings:
    """How features are found and matched, and when a frame counts as placed by them."""

    reduced: int
    """The images are reduced to one over this, if any is as large as the largest."""
    contrast: float
    inliers: int
    """Fewest points of the model that must fit the pose of a frame."""
    again: str = ""


_FIRST = _FeatureSettings(reduced=1, contrast=0.02 / 3, inliers=30)
"""COLMAP's defaults."""
_SECOND = _FeatureSettings(reduced=2, contrast=0.002, inliers=15, again=" again")
"""For frames with a blur of 24 px at 480: at half the size it is half as long, and what contrast it left is
enough (docs/experiments/poses.md)."""


def main() -> int:
    """Do the job; the exit code is 3 when it failed with a reason that was reported."""
    report = reports_to_parent()
    job = Job.model_validate(read_json(Path(sys.argv[1])))
    try:
        _Sfm(job, report).run()
    except StageError as error:
        report(error=str(error), hint=error.hint)
        return 3
    return 0


class _Sfm:
    """The steps of a job."""

    def __init__(self, job: Job, report: Callable[..., None]) -> None:
        self._job = job
        self._report = report
        self._database = job.folder / "database.db"
        self._output = job.folder / "model.partial"
        self._options = pycolmap.IncrementalPipelineOptions(
            num_threads=1, random_seed=job.seed, extract_colors=False
        )
        self._options.mapper.num_threads = 1
        self._options.mapper.random_seed = job.seed
        self._options.triangulation.random_seed = job.seed

    def run(self) -> None:
        """Make the model and its `SfmOutcome`. Raises StageError when the frames give none."""
        job = self._job
        pycolmap.set_random_seed(job.seed)
        self._import()
        self._extract(self._database, job.names, _FIRST)
        with pycolmap.Database.open(self._database) as opened:
            if opened.num_keypoints() == 0:
                raise StageError(
                    "no features were found in any frame",
                    hint="the frames need texture and light, and masks must leave some of them",
                )
        first, *others = (job.images / name for name in job.names)
        if all(filecmp.cmp(first, other, shallow=False) for other in others):
            raise StageError(
                f"all {len(job.names)} frames show the same picture",
                hint="the camera must move while it records; look whether the video froze",
            )
        pairs = self._pairs()
        self._match(self._database, pairs, _FIRST)
        make_folder(self._output, empty=True)
        if job.poses is None:
            model = self._map()
            model, placed = self._place_the_rest(model, pairs)
            outcome = SfmOutcome(placed=placed)
        else:
            model = self._triangulate()
            missed = _median_error(model)
            outcome = SfmOutcome(missed_px=missed)
            if missed > job.config.refine_above:
                adjusted = self._refine(copy.deepcopy(model))
                if adjusted is not None and _median_error(adjusted) <= _CONVINCING * missed:
                    model, outcome = adjusted, SfmOutcome(missed_px=missed, refined=True)
        make_folder(self._output, empty=True)
        model.write_binary(self._output)
        write_json(self._output / OUTCOME, outcome.model_dump())
        sync_tree(self._output)
        self._output.rename(job.folder / "model")
        sync(job.folder)

    def _import(self) -> None:
        """Create the database with cameras and images in frame order: ids do not depend on threads."""
        job = self._job
        if self._database.exists():
            with pycolmap.Database.open(self._database) as opened:
                if opened.num_images() == len(job.names):
                    return
            remove_database(self._database)
        cameras = [pycolmap.Camera(**asdict(camera)) for camera in job.cameras]
        for camera, image in zip(cameras, job.exif_images, strict=True):
            if image is not None:
                apply_exif_focal(camera, image)
        with pycolmap.Database.open(self._database) as opened, pycolmap.DatabaseTransaction(opened):
            for index, camera in enumerate(cameras):
                camera.camera_id = index + 1
                opened.write_camera(camera, use_camera_id=True)
                rig = pycolmap.Rig(rig_id=index + 1)
                rig.add_ref_sensor(camera.sensor_id)
                opened.write_rig(rig, use_rig_id=True)
            for index, (name, number) in enumerate(zip(job.names, job.camera_of, strict=True)):
                shot = pycolmap.Image(name=name, camera_id=number + 1, image_id=index + 1)
                opened.write_image(shot, use_image_id=True)
                frame = pycolmap.Frame(frame_id=index + 1, rig_id=number + 1)
                frame.add_data_id(shot.data_id)
                opened.write_frame(frame, use_frame_id=True)

    def _extract(self, database: Path, names: Sequence[str], settings: _FeatureSettings) -> None:
        """SIFT on the working images; frames that have features already are skipped by COLMAP."""
        job = self._job
        options = pycolmap.FeatureExtractionOptions(num_threads=job.threads, use_gpu=False)
        largest = max(max(camera.width, camera.height) for camera in job.cameras)
        options.max_image_size = largest // settings.reduced
        options.sift.max_num_features = job.config.max_features
        options.sift.peak_threshold = settings.contrast
        reader = pycolmap.ImageReaderOptions()
        if job.masks is not None:
            reader.mask_path = job.masks
        self._report(phase=f"finding features{settings.again}", total=len(names))
        size = 4 * job.threads
        for start in range(0, len(names), size):
            block = list(names[start : start + size])
            pycolmap.extract_features(
                database, job.images, image_names=block, reader_options=reader, extraction_options=options
            )
            self._report(done=start + len(block))

    def _match(self, database: Path, pairs: Sequence[tuple[int, int]], settings: _FeatureSettings) -> None:
        """Match and verify pairs of frames; pairs that were matched before are skipped."""
        job = self._job
        self._report(phase=f"matching{settings.again}", total=len(pairs))
        match_pairs(
            database, job.names, pairs, job.seed, job.threads, lambda through: self._report(done=through)
        )

    def _pairs(self) -> list[tuple[int, int]]:
        """All pairs of frames, or neighbours and distant frames that look alike."""
        frames, config = len(self._job.names), self._job.config
        if frames < config.exhaustive_below:
            return list(combinations(range(frames), 2))
        near = sequential_pairs(frames, config.overlap)
        if not config.loop_candidates:
            return near
        self._report(phase="looking for loops", total=None)
        with pycolmap.Database.open(self._database) as opened:
            descriptors = [np.asarray(opened.read_descriptors(index + 1).data) for index in range(frames)]
        loops = loop_pairs(descriptors, config.loop_candidates, 2 * config.overlap, self._job.seed)
        return sorted({*near, *loops})

    def _map(self) -> pycolmap.Reconstruction:
        """Incremental mapping; the model with the most registered frames (the first of equals)."""
        total = len(self._job.names)
        options = copy.deepcopy(self._options)
        options.min_model_size = min(_MIN_MODEL, max(3, total // 3))
        options.max_num_models = 5
        # COLMAP's 1.1 adjusts the whole model after every tenth frame more: half as much again, equal errors.
        options.ba_global_frames_ratio = options.ba_global_points_ratio = 1.4
        self._report(phase="reconstructing", total=total)
        registered = count(3)  # after the first pair
        models = pycolmap.incremental_mapping(
            self._database,
            self._job.images,
            self._output,
            options,
            initial_image_pair_callback=lambda: self._report(done=2),
            next_image_callback=lambda: self._report(done=min(next(registered), total)),
        )
        if not models:
            raise StageError(
                "no two frames could be matched well enough to start a reconstruction",
                hint="record more frames with more overlap and texture, "
                "and move the camera rather than turn it",
            )
        return max(models.values(), key=lambda model: model.num_reg_images())

    def _place_the_rest(
        self, model: pycolmap.Reconstruction, pairs: Sequence[tuple[int, int]]
    ) -> tuple[pycolmap.Reconstruction, dict[str, str]]:
        """Go on mapping with the features of the frames without a pose found anew by `_SECOND`; how each
        frame was placed, or why it was not.

        Works in a copy of the database: a killed run finds the first as it was.
        """
        names = self._job.names
        first = _names_in(model)
        missing = [index for index, name in enumerate(names) if name not in first]
        if not missing:
            return model, dict.fromkeys(names, "sfm")
        second = self._database.with_name("second.db")
        copy_without_features(self._database, second, [index + 1 for index in missing])
        self._extract(second, [names[index] for index in missing], _SECOND)
        self._match(second, [pair for pair in pairs if not set(missing).isdisjoint(pair)], _SECOND)
        self._report(phase="placing frames again", total=None)
        options = copy.deepcopy(self._options)
        options.multiple_models = False
        options.mapper.abs_pose_min_num_inliers = _SECOND.inliers
        start = self._output / "first"
        make_folder(start)
        model.write_binary(start)
        models = pycolmap.incremental_mapping(
            second, self._job.images, self._output, options, input_path=start
        )
        model = max([model, *models.values()], key=lambda model: model.num_reg_images())
        placed = dict.fromkeys(_names_in(model), "sfm at half resolution") | dict.fromkeys(first, "sfm")
        reasons = why_missing(second, [index + 1 for index, name in enumerate(names) if name not in placed])
        return model, placed | {names[image_id - 1]: reason for image_id, reason in reasons.items()}

    def _triangulate(self) -> pycolmap.Reconstruction:
        """Points at the given poses and cameras, which stay as they are here."""
        assert self._job.poses is not None
        self._report(phase="triangulating", total=None)
        model = pycolmap.Reconstruction()
        with pycolmap.Database.open(self._database) as opened:
            for camera in opened.read_all_cameras():
                model.add_camera_with_trivial_rig(camera)
            for image in sorted(opened.read_all_images(), key=lambda image: image.image_id):
                model.add_image_with_trivial_frame(
                    pycolmap.Image(name=image.name, camera_id=image.camera_id, image_id=image.image_id),
                    pycolmap.Rigid3d(np.array(self._job.poses[image.image_id - 1])),
                )
        return self._with_points(model)

    def _with_points(self, model: pycolmap.Reconstruction) -> pycolmap.Reconstruction:
        """``model`` with points triangulated again."""
        return pycolmap.triangulate_points(
            model, self._database, self._job.images, self._output, options=self._options
        )

    def _refine(self, model: pycolmap.Reconstruction) -> pycolmap.Reconstruction | None:
        """Adjust poses and points to the features; the cameras stay.

        At better poses more features find their points, so both are done in turn. The features leave place,
        turn and size of the whole open: the adjusted cameras are laid over the given ones by a similarity. A
        frame that few points hold keeps its given pose. None where few points hold every frame.
        """
        given = {
            frame_id: pycolmap.Rigid3d(frame.rig_from_world.matrix())
            for frame_id, frame in model.frames.items()
        }
        before = {image.name: _centre_and_axes(image) for image in model.images.values()}
        options = pycolmap.BundleAdjustmentOptions(
            refine_focal_length=False, refine_extra_params=False, print_summary=False
        )
        # Wrong matches are still among them.
        options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
        options.ceres.solver_options.num_threads = 1
        self._report(phase="adjusting poses", total=_REFINEMENTS)
        for done in range(_REFINEMENTS):
            pycolmap.bundle_adjustment(model, options)
            model = self._with_points(model)
            self._report(done=done + 1)
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


def _median_error(model: pycolmap.Reconstruction) -> float:
    """Median over the points of their mean reprojection error, px; 0 without any point."""
    errors = [point.error for point in model.points3D.values()]
    return float(np.median(errors)) if errors else 0.0


def _centre_and_axes(image: pycolmap.Image) -> NDArray[np.float64]:  # [4, 3]
    """Where a camera is, and the points at distance 1 on its axes: the centres of a straight path alone leave
    the turn about it open. (1 is the distance of the farthest camera in the normalised world.)
    """
    centre: NDArray[np.float64] = image.projection_center()
    return np.vstack([centre, centre + image.cam_from_world().rotation.matrix()])


def _names_in(model: pycolmap.Reconstruction) -> set[str]:
    return {image.name for image in model.images.values()}


if __name__ == "__main__":
    sys.exit(main())
