"""The COLMAP side of ingest: ``python -m cleargs.capture.sfm_worker job.json``, run by `cleargs.capture.sfm`.

It reads its job from JSON, works in ``job["folder"]`` and writes a binary model to ``folder/model``. Features
and matches (`cleargs.capture.sfm_features`) of a killed run are used again. `cleargs.capture.mapping` places
the frames.

The result is the same for any number of threads: ids are given in frame order before any thread starts, every
random choice is seeded, frames are matched by processes, and mapping and triangulation (whose least squares
sum in thread order) run on one thread.
"""

from __future__ import annotations

import filecmp
import sys
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cleargs.capture.adjustment import SHARED_BY, Adjuster, adjust_all, align_to, lens_of, median_residual
from cleargs.capture.camera_models import FIRST_LENS, FISHEYE
from cleargs.capture.cameras import guessed_camera
from cleargs.capture.child import reports_to_parent
from cleargs.capture.colmap import pycolmap
from cleargs.capture.database import colmap_cameras, copy_features, create_database, set_cameras
from cleargs.capture.frame_fit import halves_apart
from cleargs.capture.kept_out import all_tracks, epipolar_errors, verified_matches, weakest_join
from cleargs.capture.lenses import FISHEYE_AHEAD, GAIN, Fit, fitted, is_impossible, searched
from cleargs.capture.mapping import Mapper, names_in
from cleargs.capture.parallax import LITTLE_BELOW, NO_DEPTH_BELOW, depth_share
from cleargs.capture.prediction import scales_differ
from cleargs.capture.second_motion import second_motion
from cleargs.capture.sfm_features import FIRST
from cleargs.capture.sfm_job import LITTLE_DEPTH, MOVE, NO_DEPTH, OUTCOME, OWN, Job, SfmOutcome
from cleargs.capture.steady import steadied
from cleargs.capture.unturned import TURNED, USUAL_FOCAL, refocused, turned
from cleargs.errors import StageError
from cleargs.files import make_folder, sync, sync_tree, write_json
from cleargs.safe_io import read_json

_CONVINCING, _UNEXPLAINED, _EXPLAINED = 0.3, 0.05, 1.3
"""Other poses and cameras replace given ones if the median error of the kept-out matches falls to a share of
the error before: `_CONVINCING`, or `_UNEXPLAINED` if the new error is above `_EXPLAINED` times the error with
a separate geometry per pair. Poses that bend to explain blur or a rolling shutter are farther from the truth
than given ones, unless these are far off. All three, and the next, are from docs/experiments/poses.md."""
_NEARER = 0.9
"""SfM is preferred to adjusted poses only if it lowers the mean error to at most this share. If both are
right, they are alike, and only adjusted poses are exactly in the user's world."""
_FITS_PX, _FITS = 2.0, 0.5
"""Poses fit the images if at least this share of the matches is within this distance, px, of its epipolar
line. Measured on a synthetic room: 0.99 with true poses, 0.21 with OpenCV's axes, 0.13 with inverted ones."""


def main() -> int:
    """Run the job. Return the exit code: 3 if the job failed for a reason that was reported."""
    report = reports_to_parent()
    job = Job.model_validate(read_json(Path(sys.argv[1])))
    try:
        Sfm(job, report).run()
    except StageError as error:
        report(error=str(error), hint=error.hint)
        return 3
    return 0


class Sfm(Mapper):
    """The steps of a job."""

    def run(self) -> None:
        """Make the model and its `SfmOutcome`. Raises StageError if the frames give none."""
        job = self.job
        pycolmap.set_random_seed(job.seed)
        create_database(self.database, job)
        self.extract(self.database, job.names, FIRST)
        with pycolmap.Database.open(self.database) as opened:
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
        pairs = self.pairs()
        self.match(self.database, pairs)
        make_folder(self.output, empty=True)
        if job.poses is not None:
            model, outcome = self._from_poses(job.poses, pairs)
        else:
            model, outcome = self._from_images(pairs)
        make_folder(self.output, empty=True)
        model.write_binary(self.output)
        write_json(self.output / OUTCOME, outcome.model_dump())
        sync_tree(self.output)
        self.output.rename(job.folder / "model")
        sync(job.folder)

    def _from_images(self, pairs: Sequence[tuple[int, int]]) -> tuple[pycolmap.Reconstruction, SfmOutcome]:
        """Return the model of the images alone, with the lens that predicts the kept-out tracks best.

        Another kind of lens, with a focal length that is searched, is tried if these tracks contradict the
        cameras, or if no lens has such a focal length.
        """
        deep = depth_share(self.database)
        if deep <= NO_DEPTH_BELOW:
            raise StageError(NO_DEPTH, hint=MOVE)
        tried = self
        if self.job.config.camera_model == FISHEYE:
            _, share, _ = self._searched(FISHEYE)
            tried = self._with_lens(FISHEYE, share)
        fit: Fit | None = None
        placed: dict[str, str] = {}
        failed: StageError | None = None
        try:
            model, placed = tried.mapped(pairs)
            self._report(phase="measuring the lens", total=None)
            fit = fitted(tried, model)
        except StageError as error:
            failed = error
        other = self._other_lens(fit) if self.job.config.camera_model == "auto" else None
        if other is not None:
            self._report(phase="trying another lens", total=None)
            try:
                model, others = other.mapped(pairs)
                again = fitted(other, model, None if fit is None else fit.adjuster)
                whole = fit is None or model.num_reg_images() >= fit.model.num_reg_images()
                if fit is None or (whole and fit.error_of(again.judged) <= GAIN * fit.error_of(fit.judged)):
                    tried, fit, placed = other, again, others
            except StageError as error:
                failed = failed or error
        if fit is None:
            assert failed is not None
            if deep <= LITTLE_BELOW:
                raise StageError(f"{failed}: {LITTLE_DEPTH}", hint=MOVE)
            raise failed
        fit, focal_open = self._with_focal(fit)
        model, shifts = steadied(fit.model, adjust_all)
        # The kept-out tracks have no shift, so they say nothing about the cameras of a stabilised video.
        figure, figures = (None, {}) if shifts else fit.predictions()
        join, _ = weakest_join(model, tried.used_database)
        torn = not shifts and scales_differ(all_tracks(tried.used_database), model, join)
        outcome = SfmOutcome(
            placed=placed,
            method="sfm",
            lens=lens_of(model),
            torn_at=join - 1 if torn else None,
            elsewhere=sorted(tried.elsewhere - names_in(model)),
            focal_open=focal_open,
            strange_lens=fit.adjuster.asks_for_strange_lens
            or any(map(is_impossible, model.cameras.values())),
            little_depth=deep <= LITTLE_BELOW,
            halves_apart=0.0 if shifts else round(halves_apart(model), 6),
            second_motion=0.0 if shifts else round(second_motion(model, tried.used_database), 6),
            shifts_px={model.images[key].name: (float(x), float(y)) for key, (x, y) in shifts.items()},
            prediction=figure,
            predictions=figures,
        )
        return model, outcome

    def _with_focal(self, fit: Fit) -> tuple[Fit, bool]:
        """Return ``fit`` with the stated or the usual focal length if its cameras look the same way.

        Also returns True if the focal length is open, and nobody states it.
        """
        camera = colmap_cameras(self.job)[0]
        if len(fit.model.cameras) > 1 or lens_of(fit.model) == FISHEYE or turned(fit.model) >= TURNED:
            return fit, False
        stated = camera.has_prior_focal_length
        focal = camera.mean_focal_length() if stated else USUAL_FOCAL * max(camera.width, camera.height)
        model = refocused(fit.model, focal)
        judged = model if fit.judged is fit.model else refocused(fit.judged, focal)
        return Fit(model, fit.adjuster, judged), not stated

    def _other_lens(self, fit: Fit | None) -> Sfm | None:
        """Return the steps with another lens that may explain the matches better than ``fit`` does, or None.

        The search takes a second, so a lens without distortion that predicts the kept-out tracks is not
        doubted. From about the same focal length, mapping ends alike.
        """
        if fit is not None and not fit.doubtful and fit.is_straight:
            return None
        kind, share, ahead = self._searched(FISHEYE, "SIMPLE_PINHOLE")
        if fit is not None and not (kind == FISHEYE and ahead >= FISHEYE_AHEAD):
            alike = kind != FISHEYE and fit.has_focal(share)
            if alike or not fit.doubtful:
                return None
        return self._with_lens(kind, share)

    def _searched(self, *kinds: str) -> tuple[str, float, float]:
        """Return the kind of lens that most matches fit, its focal length in long sides, and by how much.

        The last is the ratio of the fitting matches to those of the next kind. A stated focal length is kept.
        """
        cameras = colmap_cameras(self.job)
        camera = cameras[Counter(self.job.camera_of).most_common(1)[0][0]]
        known = self.job.known_focal
        found = {kind: searched(self.database, kind, camera, known.get(kind)) for kind in kinds}
        first, *others = sorted(kinds, key=lambda kind: -found[kind][1])
        ahead = found[first][1] / max([1, *(found[kind][1] for kind in others)])
        return first, found[first][0], ahead

    def _with_lens(self, kind: str, share: float) -> Sfm:
        """Return the steps with this kind of lens, and this focal length in long sides."""
        job = self.job
        model = kind if kind == FISHEYE else FIRST_LENS
        other = self.variant(
            "another-lens",
            cameras=[guessed_camera(model, c.width, c.height, share) for c in job.cameras],
            exif_images=[None] * len(job.cameras),
            focal_known=True,
            known_focal={},
        )
        pycolmap.set_random_seed(job.seed)
        options = pycolmap.TwoViewGeometryOptions()
        options.ransac.random_seed = job.seed
        with pycolmap.Database.open(other.database) as opened:
            opened.clear_two_view_geometries()
        pycolmap.geometric_verification(
            other.database,
            pycolmap.GeometricVerifierOptions(num_threads=1),
            two_view_geometry_options=options,
        )
        return other

    def variant(self, name: str, **changes: Any) -> Sfm:
        """Return the steps of a changed job, in the folder ``name``, with the same features and matches."""
        folder = self.job.folder / name
        make_folder(folder, empty=True)
        other = Sfm(self.job.model_copy(update={"folder": folder, **changes}), self._report)
        make_folder(other.output, empty=True)
        create_database(other.database, other.job)
        copy_features(self.used_database, other.database)
        return other

    def _from_poses(
        self, given: Mapping[str, list[list[list[float]]]], pairs: Sequence[tuple[int, int]]
    ) -> tuple[pycolmap.Reconstruction, SfmOutcome]:
        """Return the model at the input's poses, or at other poses if the images contradict these."""
        convention = self._convention(given)
        start = self.triangulate(given[convention])
        missed = median_residual(start)
        outcome = SfmOutcome(missed_px=missed, convention=convention)
        adjuster = Adjuster(self.database, self.with_points)
        figure, figures = Fit(start, adjuster, start).predictions()
        outcome = outcome.model_copy(update={"prediction": figure, "predictions": figures})
        if missed <= self.job.config.refine_above and len(start.points3D):
            return start, outcome
        models = {"given": start}
        self._report(phase="adjusting poses and cameras", total=None)
        shared = len(self.job.names) >= SHARED_BY * len(self.job.cameras)
        adjusted = adjuster.refine(start, cameras=shared) if len(start.points3D) else None
        if adjusted is not None:
            models["adjusted"] = adjusted
        found, placed = self.sfm_over(start, pairs, adjuster)
        if found is not None:
            models["sfm"] = found
        errors = {method: adjuster.median_error(model) for method, model in models.items()}
        best = "given" if adjusted is None else "adjusted"
        limit = np.inf if adjusted is None else _NEARER * adjuster.mean_error(adjusted)
        if found is not None and adjuster.mean_error(found) <= limit:
            best = "sfm"
        share = _CONVINCING if errors[best] <= _EXPLAINED * adjuster.floor else _UNEXPLAINED
        if not 0 < errors[best] <= share * errors["given"]:
            return start, outcome.model_copy(update={"errors_px": errors})
        figure, figures = Fit(models[best], adjuster, models[best]).predictions()
        model = self.with_points(models[best], self.used_database if best == "sfm" else self.database)
        update: dict[str, Any] = {"prediction": figure, "predictions": figures}
        update |= {"method": best, "lens": lens_of(model), "placed": placed if best == "sfm" else {}}
        return model, outcome.model_copy(update={"errors_px": errors, **update})

    def _convention(self, given: Mapping[str, list[list[list[float]]]]) -> str:
        """Return the convention whose poses fit the matches best; `OWN` if it fits, or if no other does."""
        if len(given) == 1:
            return OWN
        matches = verified_matches(self.database)
        cameras = colmap_cameras(self.job)
        camera_of = {index + 1: cameras[number] for index, number in enumerate(self.job.camera_of)}
        fits = {}
        for convention, matrices in given.items():
            poses = {index + 1: np.array(matrix) for index, matrix in enumerate(matrices)}
            off = epipolar_errors(matches, poses, camera_of)
            fits[convention] = float((off < _FITS_PX).mean()) if len(off) else 0.0
        best = max(fits, key=lambda convention: fits[convention])
        return best if fits[OWN] < _FITS <= fits[best] else OWN

    def sfm_over(
        self, given: pycolmap.Reconstruction, pairs: Sequence[tuple[int, int]], adjuster: Adjuster
    ) -> tuple[pycolmap.Reconstruction | None, dict[str, str]]:
        """Return the model of structure from motion in the world of ``given``, and how frames were placed.

        The last adjustment does not use the matches that ``adjuster`` keeps out. The model is None if a frame
        has no pose.
        """
        job = self.job
        guesses = [guessed_camera(FIRST_LENS, camera.width, camera.height) for camera in job.cameras]
        unknown = job.model_copy(update={"cameras": guesses})
        set_cameras(self.database, colmap_cameras(unknown))
        try:
            model, placed = self.mapped(pairs)
        except StageError:
            return None, {}
        if model.num_reg_images() < len(job.names):
            return None, {}
        # Frames that were placed again have other features. The same tracks of all others are kept out.
        if self.used_database != self.database:
            adjuster = Adjuster(self.used_database, self.with_points)
        model, _ = adjuster.with_measured_lens(adjuster.adjust(model, cameras=True))
        align_to(model, given, model.images.values())
        return model, placed


if __name__ == "__main__":
    sys.exit(main())
