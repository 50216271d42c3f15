"""Choice of the lens of a capture, by tracks that no fit uses.

Incremental mapping assumes one perspective lens that does not change. A lens that zooms, breathes or is
switched, and a fisheye, give poses that fit the features and are wrong: of a walk with a zoom of 1.8 the
camera centres were off by 11 % at a median error of 0.7 px. Other lenses are tried where the images ask for
it, and taken if they predict the kept-out tracks better.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from cleargs.capture.adjustment import Adjuster, has_strange_aspect, lens_of, set_lens
from cleargs.capture.camera_models import FIRST_LENS, FULL_LENS
from cleargs.capture.cameras import has_usual_focal
from cleargs.capture.colmap import pycolmap
from cleargs.capture.frame_fit import MIN_KEYPOINTS, misses_of, robust_step, slopes_of
from cleargs.capture.prediction import WITHIN_PX, prediction_errors
from cleargs.capture.sfm_job import Job, Prediction
from cleargs.types import ArrayF64

DOUBTFUL = 0.8
"""Share of the kept-out keypoints within `WITHIN_PX` below which other lenses are tried."""
GAIN, ROUNDS = 0.9, 3
"""A focal length per frame is taken if it lowers the median error of the kept-out keypoints to at most this
share, another kind of lens if it lowers the mean error so; rounds of adjustment and triangulation. A focal
length per frame changed the median by -1 to 2 % in eight rooms without a change, and by -31 % in one whose
focal length breathes by 1.5 %; its mean changed by -9 %."""
CAPPED_PX = 4.0
"""Largest error of a keypoint in the mean."""
FOCAL_DOUBT, FOCAL_CHANGE = 4.0, 1e-3
"""A focal length per frame is tried if the keypoints of the frames ask for changes of more than this number
of standard errors and by more than this share (root mean squares over the frames). In a room without a change
these are 0.9 and 0.0002, in one whose focal length breathes by 1.5 % 22 and 0.005. Frames with fewer than
`MIN_KEYPOINTS` do not count."""
ALIKE, AS_GOOD = 0.015, 1.02
"""Largest difference of the logarithms of neighbouring focal lengths of frames that share a lens; twice it is
the largest in all of them. Frames share lenses if the error is at most this many times that with one each."""
FAR_APART = 100.0
"""Difference of logarithms that no two focal lengths have."""
START_FOCALS = (0.25, 0.3, 0.36, 0.43, 0.52, 0.62, 0.75, 0.9, 1.2, 1.8, 3.0)
"""Focal lengths, in long sides, that a search tries."""
FISHEYE_AHEAD = 1.03
"""A fisheye is tried if this number of times as many matches fit one as fit a perspective lens."""
STRAIGHT, ALIKE_FOCALS = 0.05, 1.15
"""Largest distortion at the corners, a share of their distance from the centre, of a lens that cannot be a
fisheye: one of 40 degrees from corner to corner has 4 %. Largest ratio of two focal lengths from which
reconstructions end alike."""
SEARCHED_PAIRS, MIN_MATCHES, MAX_MATCHES, SEARCH_PX = 12, 60, 250, 1.0
"""Most pairs of frames of a search, fewest and most matches of a pair, and distance of a match that fits."""


class Steps(Protocol):
    """The parts of `cleargs.capture.sfm_worker.Sfm` that are used here."""

    job: Job
    used_database: Path

    def with_points(self, model: pycolmap.Reconstruction, database: Path) -> pycolmap.Reconstruction:
        """See `Sfm.with_points`."""

    def variant(self, name: str, **changes: Any) -> Steps:
        """See `Sfm.variant`."""


@dataclass(frozen=True, eq=False)
class Fit:
    """A model, and how well its cameras predict tracks that took no part in their fit."""

    model: pycolmap.Reconstruction
    adjuster: Adjuster
    judged: pycolmap.Reconstruction
    """The model itself, or the same model adjusted without the tracks that ``adjuster`` keeps out."""

    @cached_property
    def errors(self) -> ArrayF64:
        """Errors of the kept-out keypoints, px; see `prediction_errors`."""
        return prediction_errors(self.adjuster.tracks, self.judged)

    def error_of(self, model: pycolmap.Reconstruction) -> float:
        """Return the mean error, px, of this fit's kept-out keypoints by ``model``."""
        return self._errors_of(model)[0]

    def is_beaten_by(self, model: pycolmap.Reconstruction) -> bool:
        """Return True if ``model`` lowers the median error of this fit's kept-out keypoints by `GAIN`.

        Wrong matches, which no cameras explain, are a large part of the mean: it must not grow.
        """
        (mean, median), (before, middle) = self._errors_of(model), self._errors_of(self.judged)
        return median <= GAIN * middle and mean <= before

    def _errors_of(self, model: pycolmap.Reconstruction) -> tuple[float, float]:  # mean, median
        errors = self.errors if model is self.judged else prediction_errors(self.adjuster.tracks, model)
        known = np.minimum(errors[~np.isnan(errors)], CAPPED_PX)
        return (float(known.mean()), float(np.median(known))) if len(known) else (CAPPED_PX, CAPPED_PX)

    @property
    def doubtful(self) -> bool:
        """True if the tracks contradict the cameras, or no lens has such a focal length."""
        errors = self.errors
        known = errors[~np.isnan(errors)]
        few = len(known) > 0 and float((known < WITHIN_PX).mean()) < DOUBTFUL
        return few or any(map(is_impossible, self.judged.cameras.values()))

    @property
    def is_straight(self) -> bool:
        """True if the lens of all frames is `STRAIGHT`, so that no fisheye took the pictures."""
        return max(map(distortion, self.judged.cameras.values())) <= STRAIGHT

    def has_focal(self, share: float) -> bool:
        """Return True if the lens of all frames has about this focal length, in long sides."""
        return all(
            abs(np.log(camera.mean_focal_length() / max(camera.width, camera.height) / share))
            <= np.log(ALIKE_FOCALS)
            for camera in self.judged.cameras.values()
        )

    def predictions(self) -> tuple[Prediction | None, dict[str, Prediction]]:
        """Return the figure of the capture, and that of each image by its name."""
        errors, images = self.errors, self.adjuster.tracks.image
        known = ~np.isnan(errors)
        rows = {key: errors[known & (images == key)] for key in np.unique(images[known]).tolist()}
        named = {self.judged.images[key].name: _prediction(found) for key, found in rows.items()}
        return (_prediction(errors[known]) if known.any() else None), named


def _prediction(errors: ArrayF64) -> Prediction:
    median = min(float(np.median(errors)), 1e4)  # JSON has no infinity
    return Prediction(
        keypoints=len(errors), share=round(float((errors < WITHIN_PX).mean()), 6), median_px=round(median, 6)
    )


def is_impossible(camera: pycolmap.Camera) -> bool:
    """Return True if no usual lens has the focal lengths of ``camera``, and nobody stated them."""
    share = camera.mean_focal_length() / max(camera.width, camera.height)
    stated = camera.has_prior_focal_length
    return has_strange_aspect(camera) or not (stated or has_usual_focal(camera.model.name, share))


def distortion(camera: pycolmap.Camera) -> float:
    """Return how far the corners are from their places without distortion, as a share; infinity: no ray."""
    corners = np.array([[x, y] for x in (0.0, camera.width) for y in (0.0, camera.height)])
    rays = np.asarray(camera.cam_from_img(corners), np.float64).reshape(-1, 2)
    focal = np.array([camera.focal_length_x, camera.focal_length_y])
    centre = np.array([camera.principal_point_x, camera.principal_point_y])
    straight = np.linalg.norm(rays * focal, axis=1)
    away = np.abs(np.linalg.norm(corners - centre, axis=1) / np.maximum(straight, 1e-12) - 1.0)
    return float(np.where(np.isfinite(away), away, np.inf).max())


def fitted(sfm: Steps, model: pycolmap.Reconstruction, like: Adjuster | None = None) -> Fit:
    """Return ``model``, which all matches made, with the lens that predicts the kept-out tracks best.

    The tracks that ``like`` keeps out are kept out too.
    """
    config = sfm.job.config
    adjuster = Adjuster(sfm.used_database, sfm.with_points, like)
    if config.camera_model == "auto":
        best, judged = adjuster.with_measured_lens(model)
    else:
        best, judged = model, adjuster.adjust(model, cameras=True)
    fit = Fit(best, adjuster, judged)
    if not config.shared_camera or not _focal_length_changes(judged):
        return fit
    own = _with_lenses(sfm, fit, list(range(len(sfm.job.names))), "own-cameras")
    if not own.model.points3D or not fit.is_beaten_by(own.model):
        return fit
    owners = lens_owners(own.model, sfm.job.camera_of)
    if len(set(owners)) in (1, len(owners)):
        return own
    shared = _with_lenses(sfm, own, owners, "shared-cameras")
    alike = shared.model.points3D and fit.error_of(shared.model) <= AS_GOOD * fit.error_of(own.model)
    return shared if alike else own


def _with_lenses(sfm: Steps, fit: Fit, owners: list[int], name: str) -> Fit:
    """Return ``fit`` after an adjustment with the camera number ``owners`` [F] for each frame."""
    job, first = sfm.job, [owners.index(number) for number in range(max(owners) + 1)]
    other = sfm.variant(
        name,
        cameras=[job.cameras[job.camera_of[frame]] for frame in first],
        exif_images=[job.exif_images[job.camera_of[frame]] for frame in first],
        camera_of=owners,
    )
    adjuster = Adjuster(other.used_database, other.with_points, fit.adjuster)
    start = _with_cameras(fit.model, owners)
    if sfm.job.config.camera_model == "auto" and lens_of(start) == FULL_LENS:
        set_lens(start, FIRST_LENS)  # many terms explain a wrong focal length, and fit a frame alone poorly
    changed = adjuster.triangulated(start)
    for _ in range(ROUNDS):
        changed = adjuster.bundle_adjusted(changed, cameras=True)
    return Fit(changed, adjuster, changed)


def lens_owners(model: pycolmap.Reconstruction, before: Sequence[int]) -> list[int]:
    """Return the number of the lens of each frame, by the focal lengths of ``model``, a camera per frame.

    Frames with focal lengths that are `ALIKE` share a lens: those before a change of lenses and after it, or
    the photographs of one phone. Each frame of a zoom has its own. Frames that had different cameras
    ``before`` [F], as those of other sizes have, share none.
    """
    placed = sorted(key for key, image in model.images.items() if image.has_pose)
    focal = np.log([model.cameras[model.images[key].camera_id].mean_focal_length() for key in placed])
    focal += FAR_APART * np.array([before[key - 1] for key in placed])
    order = np.argsort(focal, kind="stable")
    group = np.zeros(len(placed), np.int64)
    group[order] = np.cumsum(np.diff(focal[order], prepend=focal[order[0]]) > ALIKE)
    wide = [number for number in np.unique(group) if np.ptp(focal[group == number]) > 2 * ALIKE]
    lens = {
        key: f"frame {key}" if number in wide else f"lens {number}"
        for key, number in zip(placed, group.tolist(), strict=True)
    }
    # A frame without a pose has the lens of the first frame that had its camera.
    first = {before[key - 1]: lens[key] for key in reversed(placed)}
    names = {
        key: lens.get(key) or first.get(camera, f"camera {camera}") for key, camera in enumerate(before, 1)
    }
    numbers = {name: number for number, name in enumerate(dict.fromkeys(names.values()))}
    return [numbers[name] for name in names.values()]


def _focal_length_changes(model: pycolmap.Reconstruction) -> bool:
    """Return True if the keypoints ask for another focal length in some frames (`FOCAL_DOUBT`).

    Each frame is moved, turned and zoomed to fit its points, which stay.
    """
    found = []
    for image in model.images.values():
        if not image.has_pose or image.num_points3D < MIN_KEYPOINTS:
            continue
        points, _, misses = misses_of(model, image)
        focal = model.cameras[image.camera_id].mean_focal_length()
        place, slopes = slopes_of(points, focal)
        step, covariance = robust_step(np.concatenate([slopes, focal * place[..., None]], axis=2), misses)
        found.append((step[-1], np.sqrt(covariance[-1, -1])))
    if not found:
        return False
    changes, errors = np.array(found).T
    doubt = np.sqrt(np.mean(np.square(changes / np.maximum(errors, 1e-12))))
    return bool(doubt > FOCAL_DOUBT and np.sqrt(np.mean(np.square(changes))) > FOCAL_CHANGE)


def _with_cameras(model: pycolmap.Reconstruction, owners: list[int]) -> pycolmap.Reconstruction:
    """Return the poses of ``model`` without points, and cameras by ``owners`` [F], numbers of them from 0.

    A camera is the one of its first frame with a pose. Its id is its number + 1.
    """
    other = pycolmap.Reconstruction()
    images = sorted(model.images.items(), key=lambda pair: (not pair[1].has_pose, pair[0]))
    for key, image in images:
        number = owners[key - 1] + 1
        if number not in other.cameras:
            camera = copy.deepcopy(model.cameras[image.camera_id])
            camera.camera_id = number
            other.add_camera_with_trivial_rig(camera)
    for key, image in sorted(images, key=lambda pair: pair[0]):
        shot = pycolmap.Image(name=image.name, camera_id=owners[key - 1] + 1, image_id=key)
        if image.has_pose:
            other.add_image_with_trivial_frame(shot, image.cam_from_world())
        else:
            other.add_image_with_trivial_frame(shot)
    return other


def searched(database: Path, kind: str, like: pycolmap.Camera, stated: float | None) -> tuple[float, int]:
    """Return the focal length of a lens of ``kind`` that most matches of frames fit, and how many.

    The focal length is in long sides. It is ``stated``, that in the EXIF data of ``like``, or one of
    `START_FOCALS`. The lens has no other distortion. Fitting matches are those of one essential matrix per
    pair of frames.
    """
    pairs, long = _pairs(database), max(like.width, like.height)
    best = (1.2, 0)
    if stated is None and like.has_prior_focal_length:
        stated = like.mean_focal_length() / long
    for share in START_FOCALS if stated is None else (stated,):
        camera = pycolmap.Camera.create_from_model_name(1, kind, share * long, like.width, like.height)
        fits = 0
        for first, second in pairs:
            options = pycolmap.RANSACOptions(
                max_error=SEARCH_PX, min_num_trials=50, max_num_trials=300, random_seed=0
            )
            found = pycolmap.estimate_essential_matrix(first, second, camera, camera, options)
            fits += 0 if found is None else int(found["num_inliers"])
        if fits > best[1]:
            best = (share, fits)
    return best


def _pairs(database: Path) -> list[tuple[ArrayF64, ArrayF64]]:
    """Return the matched pixels of at most `SEARCHED_PAIRS` pairs of frames that are not neighbours."""
    with pycolmap.Database.open(database) as opened:
        ids, matches = opened.read_all_matches()
        rows = {
            pycolmap.pair_id_to_image_pair(key): np.asarray(found)
            for key, found in zip(ids, matches, strict=True)
        }
        good = [
            pair for pair, found in rows.items() if len(found) >= MIN_MATCHES and abs(pair[0] - pair[1]) > 1
        ]
        good = sorted(good, key=lambda pair: (-len(rows[pair]), pair))[: max(SEARCHED_PAIRS, len(good) // 3)]
        chosen = good[:: max(1, len(good) // SEARCHED_PAIRS)][:SEARCHED_PAIRS]
        pixels = {
            key: np.asarray(opened.read_keypoints(key), np.float64)[:, :2] for pair in chosen for key in pair
        }
    thin = {pair: rows[pair][:: -(-len(rows[pair]) // MAX_MATCHES)] for pair in chosen}
    return [(pixels[one][thin[one, two][:, 0]], pixels[two][thin[one, two][:, 1]]) for one, two in chosen]
