"""Adjustment of poses, points and cameras to the features, measured on matches that it does not use."""

from __future__ import annotations

import copy
from collections.abc import Callable, Collection
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cleargs.capture.camera_models import FIRST_LENS, FULL_LENS, SIMPLE
from cleargs.capture.cameras import MAX_ASPECT
from cleargs.capture.colmap import pycolmap
from cleargs.capture.database import copy_without_features
from cleargs.capture.kept_out import epipolar_errors, keep_out
from cleargs.capture.prediction import Tracks

SHARED_BY = 8
"""Minimum number of frames per camera to adjust the cameras of the input, not only its poses."""

_ROUNDS = 4
_TOLERANCE = 1e-5
"""Relative change of the cost at which an adjustment ends. COLMAP's 0 takes three times as long for the same
poses."""

_LENS_GAIN = 0.04
"""`FULL_LENS` is chosen if it lowers the mean error of the kept-out matches by at least this share
(docs/experiments/poses.md)."""

_STRANGE_GAIN = 0.5
"""The same share for a `FULL_LENS` whose two focal lengths no lens has. On a turntable, which turns about one
axis only, 207 and 925 px (true: 188) lowered the error by 26 %. In a walk before a wall of text that scrolls
fx and fy that differ by 30 % lowered it by 9 to 19 %, and the poses were wrong, too."""

_LENS_FRAMES = 150
"""Maximum number of frames, evenly spread, to choose the lens. The time of an adjustment grows faster than
this number (docs/experiments/poses.md)."""

_CAPPED_PX = 4.0
"""Means cap each error at this value: COLMAP accepts a match within 4 px of its epipolar line."""

_FARTHEST_PX = 1e4  # larger errors, also infinite ones, count as this
_HELD_BY = 15  # minimum number of points in a frame that keeps its adjusted pose


class Adjuster:
    """Adjusts models to all matches in a database except every tenth track. These tracks measure errors."""

    def __init__(
        self,
        database: Path,
        triangulate: Callable[[pycolmap.Reconstruction, Path], pycolmap.Reconstruction],
        like: Adjuster | None = None,
    ) -> None:
        """Copy ``database``, which does not change, without the tracks that are kept out.

        ``floor`` is the `median_error` with a separate geometry for each pair of frames. ``triangulate``
        triangulates the points of a model again from the matches in a database. Tracks that ``like`` keeps
        out are kept out too.
        """
        self._cut = database.with_name(f"{database.stem}-cut.db")
        copy_without_features(database, self._cut, [])
        kept_out = keep_out(self._cut, None if like is None else like.tracks)
        self._kept_out, self.floor = kept_out.matches, kept_out.floor
        self.tracks: Tracks = kept_out.tracks
        self._triangulate = triangulate
        self.asks_for_strange_lens = False
        """True if two focal lengths that no lens has lowered the errors by `_LENS_GAIN`: poses or matches are
        wrong, the camera turned about one axis only, or the pictures are stretched."""

    def errors(self, model: pycolmap.Reconstruction) -> NDArray[np.float64]:
        """Return the distances of the kept-out matches from their epipolar lines, px of the working images.

        Matches of frames without a pose do not count.
        """
        placed = {key: image for key, image in model.images.items() if image.has_pose}
        found = epipolar_errors(
            {pair: pixels for pair, pixels in self._kept_out.items() if placed.keys() >= set(pair)},
            {key: image.cam_from_world().matrix() for key, image in placed.items()},
            {key: model.cameras[image.camera_id] for key, image in placed.items()},
        )
        return np.asarray(np.minimum(found, _FARTHEST_PX))

    def median_error(self, model: pycolmap.Reconstruction) -> float:
        """Return the median of `errors`; 0 if no match was kept out."""
        return _median(self.errors(model))

    def mean_error(self, model: pycolmap.Reconstruction) -> float:
        """Return the mean of the capped `errors`. Unlike the median, it shows single wrong frames."""
        errors = np.minimum(self.errors(model), _CAPPED_PX)
        return float(errors.sum() / max(1, len(errors)))

    def refine(self, model: pycolmap.Reconstruction, *, cameras: bool) -> pycolmap.Reconstruction | None:
        """Return ``model`` with poses, points and, with ``cameras``, lenses adjusted.

        Returns None if every frame sees too few points.
        """
        refined = copy.deepcopy(model)
        if cameras and {camera.model.name for camera in refined.cameras.values()} <= SIMPLE:
            set_lens(refined, FIRST_LENS)
        # At better poses more features find their points: adjustment and triangulation alternate.
        for _ in range(_ROUNDS):
            refined = self.bundle_adjusted(refined, cameras=cameras)
        if cameras and lens_of(refined) == FIRST_LENS:
            refined = self._with_measured_lens(refined)
        held = _held(refined)
        return _anchored(refined, model, held) if held else None

    def adjust(self, model: pycolmap.Reconstruction, *, cameras: bool) -> pycolmap.Reconstruction:
        """Return ``model``, which all matches made, after an adjustment without the kept-out matches."""
        adjusted = self.bundle_adjusted(self._triangulate(copy.deepcopy(model), self._cut), cameras=cameras)
        placed = [image for image in adjusted.images.values() if image.has_pose]
        return _anchored(adjusted, model, _held(adjusted) or placed)

    def with_measured_lens(
        self, model: pycolmap.Reconstruction
    ) -> tuple[pycolmap.Reconstruction, pycolmap.Reconstruction]:
        """Return ``model``, with `FULL_LENS` if this lens explains the kept-out matches better.

        Also returns the model by which the kept-out matches judge it: the same one if the lens changed, else
        one that is adjusted without them.
        """
        start = self.adjust(_thinned(model), cameras=True)
        if lens_of(model) != FIRST_LENS:
            return model, start
        best = self._with_measured_lens(start)
        if best is start:
            return model, start
        if best.num_reg_frames() < model.num_reg_frames():
            whole = copy.deepcopy(model)
            for key, camera in whole.cameras.items():
                camera.model, camera.params = best.cameras[key].model, best.cameras[key].params
            best = self.adjust(whole, cameras=True)
        else:
            best = _anchored(best, model, _held(best))
        return best, best

    def triangulated(self, model: pycolmap.Reconstruction) -> pycolmap.Reconstruction:
        """Return ``model`` with points from the matches that are not kept out."""
        return self._triangulate(model, self._cut)

    def _with_measured_lens(self, model: pycolmap.Reconstruction) -> pycolmap.Reconstruction:
        full = copy.deepcopy(model)
        set_lens(full, FULL_LENS)
        full = self.bundle_adjusted(full, cameras=True)
        left = self.mean_error(full) / max(self.mean_error(model), 1e-12)
        strange = any(map(has_strange_aspect, full.cameras.values()))
        self.asks_for_strange_lens = strange and left < 1 - _LENS_GAIN
        better = left < 1 - (_STRANGE_GAIN if strange else _LENS_GAIN)
        return full if better and _held(full) else model

    def bundle_adjusted(self, model: pycolmap.Reconstruction, *, cameras: bool) -> pycolmap.Reconstruction:
        """Return ``model`` after one bundle adjustment and a triangulation without the kept-out matches."""
        adjust_all(model, cameras=cameras)
        return self._triangulate(model, self._cut)


def adjust_all(model: pycolmap.Reconstruction, *, cameras: bool = True, focal: bool = True) -> None:
    """Adjust poses, points and, with ``cameras``, lenses of ``model`` in one bundle adjustment.

    Without ``focal``, the focal lengths stay.
    """
    options = pycolmap.BundleAdjustmentOptions(
        refine_focal_length=cameras and focal, refine_extra_params=cameras
    )
    options.print_summary = False
    # A robust loss, because some matches are still wrong.
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.solver_options.num_threads = 1
    options.ceres.solver_options.function_tolerance = _TOLERANCE
    pycolmap.bundle_adjustment(model, options)


def has_strange_aspect(camera: pycolmap.Camera) -> bool:
    """Return True if the two focal lengths of ``camera`` differ more than those of any lens."""
    fx, fy = camera.focal_length_x, camera.focal_length_y
    return bool(max(fx, fy) > MAX_ASPECT * min(fx, fy))


def lens_of(model: pycolmap.Reconstruction) -> str:
    """Return the names of the camera models of ``model``, separated by commas."""
    return ", ".join(sorted({camera.model.name for camera in model.cameras.values()}))


def set_lens(model: pycolmap.Reconstruction, lens: str) -> None:
    """Change all cameras to the camera model ``lens``; focal length, centre and first radial term stay."""
    for camera in model.cameras.values():
        focal = camera.mean_focal_length()
        radial = float(camera.params[3]) if camera.model.name == FIRST_LENS else 0.0
        centre = [camera.principal_point_x, camera.principal_point_y]
        camera.model = getattr(pycolmap.CameraModelId, lens)
        more = [radial] if lens == FIRST_LENS else [radial, 0.0, 0.0, 0.0]
        camera.params = [*([focal] if lens == FIRST_LENS else [focal, focal]), *centre, *more]


def _thinned(model: pycolmap.Reconstruction) -> pycolmap.Reconstruction:
    """Return ``model`` with the poses of at most `_LENS_FRAMES` frames."""
    frames = sorted(model.reg_frame_ids())
    thin = copy.deepcopy(model)
    for frame in set(frames) - set(frames[:: max(1, -(-len(frames) // _LENS_FRAMES))]):
        thin.deregister_frame(frame)
    return thin


def median_residual(model: pycolmap.Reconstruction) -> float:
    """Return the median over the points of their mean reprojection error, px; 0 without any point."""
    return _median(np.array([point.error for point in model.points3D.values()]))


def _median(errors: NDArray[np.float64]) -> float:
    return float(np.median(errors)) if len(errors) else 0.0


def align_to(
    model: pycolmap.Reconstruction, given: pycolmap.Reconstruction, held: Collection[pycolmap.Image]
) -> None:
    """Transform ``model`` by the similarity that maps its images ``held`` best to the cameras of ``given``.

    The camera axes count too, because the centres of a straight path do not fix the rotation about it.
    """
    before = {image.name: image for image in given.images.values()}
    found = pycolmap.estimate_sim3d(_marks(held), _marks([before[image.name] for image in held]))
    assert found is not None  # the four points of one camera determine a similarity
    model.transform(found)


def _marks(images: Collection[pycolmap.Image]) -> NDArray[np.float64]:
    """Return per camera its centre, and the three points at the scene's size along its axes, [4 N, 3]."""
    centres = np.stack([image.projection_center() for image in images])
    size = np.linalg.norm(centres - centres.mean(axis=0), axis=1).max()
    axes = np.stack([image.cam_from_world().rotation.matrix() for image in images])
    return np.concatenate([centres, (centres[:, None] + size * axes).reshape(-1, 3)])


def _held(model: pycolmap.Reconstruction) -> list[pycolmap.Image]:
    return [image for image in model.images.values() if image.has_pose and image.num_points3D >= _HELD_BY]


def _anchored(
    model: pycolmap.Reconstruction, given: pycolmap.Reconstruction, held: Collection[pycolmap.Image]
) -> pycolmap.Reconstruction:
    """Return ``model`` in the world of ``given``. Frames that are not in ``held`` get their given poses.

    The features do not determine position, rotation and scale of the whole. Both models have the same frames.
    """
    align_to(model, given, held)
    names = {image.name for image in held}
    poses = {image.name: image.cam_from_world() for image in given.images.values() if image.has_pose}
    for image in model.images.values():
        if image.has_pose and image.name not in names:
            model.frames[image.frame_id].rig_from_world = pycolmap.Rigid3d(poses[image.name].matrix())
    return model
