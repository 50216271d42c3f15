"""Incremental mapping, and placing again the frames that it leaves out or that contradict their matches."""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from itertools import count
from pathlib import Path

import numpy as np

from cleargs.capture.colmap import pycolmap
from cleargs.capture.database import copy_without_features, set_cameras, why_missing
from cleargs.capture.kept_out import all_tracks, fitting_shares, verified_matches, weakest_join
from cleargs.capture.prediction import scales_agree
from cleargs.capture.sfm_features import AGAIN, FIRST, Features, FeatureSettings
from cleargs.capture.sfm_job import Job
from cleargs.errors import StageError
from cleargs.files import make_folder

_MIN_MODEL = 10
"""Minimum number of frames of a model: COLMAP discards a smaller model and starts elsewhere. In a short
capture the minimum is a third of the frames, since a model of 8 of 12 frames is useful."""
_JOINED, _JOINS = 0.92, 3
"""Minimum share of the matches across a join (`weakest_join`) that hold, and maximum number of joins that are
repeated (docs/experiments/poses.md)."""
_MISPLACED, _PLACINGS, _LEFT_OUT = 0.6, 2, 0.1
"""Minimum share of a frame's matches that fit its pose; how many times frames with less are placed again;
maximum share of all frames that are then left out. If there are more, the matches are wrong, not the poses
(docs/experiments/poses.md)."""


class Mapper(Features):
    """The steps of a job that make a model from its database."""

    def __init__(self, job: Job, report: Callable[..., None]) -> None:
        super().__init__(job, report)
        self.used_database = self.database
        """The database with the features by which frames were placed."""
        self.elsewhere: set[str] = set()
        """Images of the second-largest model of the first mapping."""
        self._settled: tuple[pycolmap.Reconstruction, Path] | None = None
        """Model and database of the last call of `_rejoined`, if another call would find the same."""
        self.output = job.folder / "model.partial"
        self._options = pycolmap.IncrementalPipelineOptions(num_threads=1, random_seed=job.seed)
        self._options.extract_colors = False
        self._options.mapper.num_threads = 1
        self._options.mapper.random_seed = job.seed
        self._options.triangulation.random_seed = job.seed
        # COLMAP's 1.1 adjusts the whole model per tenth of growth: half as much time again, equal errors.
        self._options.ba_global_frames_ratio = self._options.ba_global_points_ratio = 1.4

    def mapped(self, pairs: Sequence[tuple[int, int]]) -> tuple[pycolmap.Reconstruction, dict[str, str]]:
        """Return the model of the images alone, and how frames were placed."""
        model = self._rejoined(self._corrected(self._map(), self.database), self.database)
        model, placed = self._place_the_rest(model, pairs)
        before = names_in(model)
        model = self._corrected(self._rejoined(model, self.used_database), self.used_database)
        return model, placed | dict.fromkeys(before - names_in(model), "too few of its matches fit its pose")

    def _corrected(self, model: pycolmap.Reconstruction, database: Path) -> pycolmap.Reconstruction:
        """Return ``model`` after frames that contradict their matches were placed again, or left out.

        A frame may be placed by wrong matches before the frames with right matches to it have a pose.
        """
        matches = verified_matches(database)
        shares = fitting_shares(model, matches)
        for _ in range(_PLACINGS):
            wrong = {image - 1 for image, share in shares.items() if share < _MISPLACED}
            if not wrong:
                break
            self._report(phase="placing frames again", total=None)
            found = self._continued(model, database, wrong, FIRST)
            better = fitting_shares(found, matches)
            if len(better) < len(shares) or min(better.values()) <= min(shares.values()):
                break
            model, shares = found, better
        contrary = [image for image, share in shares.items() if share < _MISPLACED]
        if contrary and len(contrary) <= _LEFT_OUT * len(shares):
            model = copy.deepcopy(model)
            for image in contrary:
                model.deregister_frame(model.images[image].frame_id)
        return model

    def _rejoined(self, model: pycolmap.Reconstruction, database: Path) -> pycolmap.Reconstruction:
        """Return ``model`` after the joins that contradict the matches across them were repeated.

        The first pair of mapping may get a wrong focal length and depth, with which the first frames fit each
        other; the next ones then go on at another scale. The smaller side of such a join is placed again from
        the larger one, unless points from each side alone show the same scale: then some matches are wrong.
        """
        if self._settled is not None and self._settled[0] is model and self._settled[1] == database:
            return model  # no frame was placed in between
        image, share = weakest_join(model, database)
        self._settled = None
        for _ in range(_JOINS):
            if share >= _JOINED or scales_agree(all_tracks(database), model, image):
                self._settled = model, database
                break
            numbers = {found.image_id - 1 for found in model.images.values() if found.has_pose}
            before = {i for i in numbers if i < image - 1}
            self._report(phase="checking a weak join", total=None)
            found = self._continued(model, database, min(before, numbers - before, key=len), FIRST)
            again, better = weakest_join(found, database)
            if better <= share or not names_in(found) >= names_in(model):
                self._settled = model, database
                break
            model, image, share = found, again, better
        return model

    def _map(self) -> pycolmap.Reconstruction:
        """Run incremental mapping. Return the model with the most registered frames (the first of equals)."""
        total = len(self.job.names)
        options = copy.deepcopy(self._options)
        options.min_model_size = min(_MIN_MODEL, max(3, total // 3))
        options.max_num_models = 5
        self._report(phase="reconstructing", total=total)
        registered = count(3)  # after the first pair

        def placed() -> None:
            number = next(registered)
            if number < total:
                self._report(done=number)
            elif number == total:
                self._report(phase="adjusting all poses", total=None)

        models = pycolmap.incremental_mapping(
            self.database,
            self.job.images,
            self.output,
            options,
            initial_image_pair_callback=lambda: self._report(done=2),
            next_image_callback=placed,
        )
        if not models:
            raise StageError(
                "no two frames could be matched well enough to start a reconstruction",
                hint="record more frames with more overlap and texture, "
                "and move the camera rather than turn it",
            )
        first, *others = sorted(models.values(), key=lambda model: -model.num_reg_images())
        self.elsewhere = names_in(others[0]) if others else set()
        return first

    def _place_the_rest(
        self, model: pycolmap.Reconstruction, pairs: Sequence[tuple[int, int]]
    ) -> tuple[pycolmap.Reconstruction, dict[str, str]]:
        """Continue mapping with other features, by `AGAIN`, while frames have no pose.

        It works in copies of the database, so that a killed run finds the first one unchanged. Returns the
        model, and for each image how it was placed or why it was not.
        """
        names, reach = self.job.names, self.job.config.overlap
        self.used_database = self.database
        placed = dict.fromkeys(names_in(model), FIRST.name)
        reasons: dict[str, str] = {}
        for settings in AGAIN:
            missing = [index for index, name in enumerate(names) if name not in placed]
            if not missing:
                break
            again = set(missing)
            if settings.neighbours:
                again = {i for i in range(len(names)) if any(abs(i - j) <= reach for j in missing)}
            database = self.database.with_name(f"{settings.name.replace(' ', '-')}.db")
            copy_without_features(self.used_database, database, [index + 1 for index in again])
            self.extract(database, [names[index] for index in sorted(again)], settings)
            self.match(database, [pair for pair in pairs if not again.isdisjoint(pair)], " again")
            self._report(phase="placing frames again", total=None)
            found = self._continued(model, database, again, settings)
            if names_in(found) > placed.keys():
                model, self.used_database = found, database
                placed = dict.fromkeys(names_in(model), settings.name) | placed
            reasons = why_missing(
                database, {i + 1: name for i, name in enumerate(names) if name not in placed}
            )
        return model, placed | reasons

    def _continued(
        self, model: pycolmap.Reconstruction, database: Path, again: set[int], settings: FeatureSettings
    ) -> pycolmap.Reconstruction:
        """Return ``model`` after mapping from ``database`` placed the frames ``again`` once more."""
        options = copy.deepcopy(self._options)
        options.multiple_models = False
        options.mapper.abs_pose_min_num_inliers = settings.inliers
        kept = copy.deepcopy(model)
        for image in model.images.values():
            if image.image_id - 1 in again and image.has_pose:
                kept.deregister_frame(image.frame_id)
        start = self.output / "start"
        make_folder(start, empty=True)
        kept.write_binary(start)
        models = pycolmap.incremental_mapping(
            database, self.job.images, self.output, options, input_path=start
        )
        return max([*models.values(), model], key=lambda model: model.num_reg_images())

    def triangulate(self, poses: Sequence[list[list[float]]]) -> pycolmap.Reconstruction:
        """Return a model with points triangulated at the given poses and cameras, which do not change."""
        self._report(phase="triangulating", total=None)
        model = pycolmap.Reconstruction()
        with pycolmap.Database.open(self.database) as opened:
            for camera in opened.read_all_cameras():
                model.add_camera_with_trivial_rig(camera)
            for image in sorted(opened.read_all_images(), key=lambda image: image.image_id):
                model.add_image_with_trivial_frame(
                    pycolmap.Image(name=image.name, camera_id=image.camera_id, image_id=image.image_id),
                    pycolmap.Rigid3d(np.array(poses[image.image_id - 1])),
                )
        return self.with_points(model, self.database)

    def with_points(self, model: pycolmap.Reconstruction, database: Path) -> pycolmap.Reconstruction:
        """Return ``model`` with points triangulated again from the matches in ``database``."""
        set_cameras(database, list(model.cameras.values()))  # COLMAP refuses a model whose lenses differ
        return pycolmap.triangulate_points(
            model, database, self.job.images, self.output, options=self._options
        )


def names_in(model: pycolmap.Reconstruction) -> set[str]:
    """Return the images of ``model`` that have a pose."""
    return {image.name for image in model.images.values() if image.has_pose}
