"""Measurement of motion and readout: ``python -m cleargs.capture.motion_worker job.json``.

A separate process, with one thread in its linear algebra, so that its sums do not depend on threads.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cleargs.capture.cameras import Intrinsics, Pose
from cleargs.capture.child import reports_to_parent
from cleargs.capture.colmap import pycolmap
from cleargs.capture.model import SparseModel, read_model, write_model
from cleargs.capture.motion import ORDER, TWIST, MeasuredMotion, Tracks, measure
from cleargs.capture.motion_job import (
    ADJUSTED,
    MOTIONS,
    OUTCOME,
    TRACKS,
    LensReadout,
    MotionJob,
    MotionOutcome,
)
from cleargs.capture.readout import Geometry, Observations, Readout, adjusted, estimate, fitted_readout
from cleargs.files import atomic_path, write_json
from cleargs.safe_io import read_json
from cleargs.types import ArrayF64

ROUNDS = 2
"""Rounds of an adjustment to a readout. Each one measures the speeds with the geometry of the one before."""
GOOD = 0.25
"""Quantile of the frames' tracking errors that is the error of a good frame. A frame counts 1 / (1 + e^2) for
the readout, with e its error over that of a good frame: in shaky frames speeds are uncertain, and uncertain
speeds make readouts too small."""
MIN_ERROR_PX = 0.02
"""Smallest error of a good frame, px."""
MIN_FRAMES = 8
"""Minimum number of measured frames of a lens."""
MAX_OBSERVATIONS = 40_000
"""Maximum number of observations for an estimate. Points are left out evenly."""


def main() -> int:
    """Run the job."""
    report = reports_to_parent()
    job = MotionJob.model_validate(read_json(Path(sys.argv[1])))
    report(phase="measuring the camera's motion", total=None)
    capture = _Capture(job)
    readouts = capture.readouts() if job.rolling_shutter else []
    if readouts:
        capture.roll(readouts, poses=not job.given)
        write_model(job.folder / ADJUSTED, *capture.model())
    _write_motions(job.folder / MOTIONS, capture.motions)
    write_json(job.folder / OUTCOME, MotionOutcome(readouts=readouts).model_dump())
    return 0


@dataclass(frozen=True, eq=False)
class _Frame:
    """A frame of the model, with its tracks if it has some."""

    image: str
    lens: int
    camera: Intrinsics
    tracks: ArrayF64 | None  # [1 + K, P, 2] px
    points: NDArray[np.int64]  # [P] numbers of the tracked points
    times: ArrayF64  # [1 + K]

    @property
    def two_sided(self) -> bool:
        """True if the frame has neighbours before and after it, and so a path of full order."""
        return bool(self.times.min() < 0.0 < self.times.max())


class _Capture:
    """Geometry, tracks and motions of the frames of a model, in the order of its images."""

    def __init__(self, job: MotionJob) -> None:
        self._model = read_model(job.model)
        tracks = np.load(job.folder / TRACKS)
        ids = self._model.point_ids
        self._frames: list[_Frame] = []
        for _, image in sorted(self._model.images.items()):
            known = f"{image.name}.places" in tracks
            self._frames.append(
                _Frame(
                    image.name,
                    job.lenses[image.name],
                    self._model.cameras[image.camera_id],
                    tracks[f"{image.name}.places"] if known else None,
                    np.searchsorted(ids, tracks[f"{image.name}.points"]) if known else np.zeros(0, np.int64),
                    np.concatenate([[0.0], tracks[f"{image.name}.times"]]) if known else np.zeros(1),
                )
            )
        images = [image for _, image in sorted(self._model.images.items())]
        cameras = sorted(self._model.cameras)
        self._start = self._geometry = Geometry(
            np.stack([image.pose.rotation for image in images]),
            np.stack([image.pose.translation for image in images]),
            self._model.xyz,
            np.ones(len(cameras)),
        )
        lens_cameras = [self._model.cameras[key] for key in cameras]
        counts = [len(image.xy) for image in images]
        self._pixels = np.concatenate([image.xy for image in images])
        self._seen = Observations(
            np.repeat(np.arange(len(images)), counts),
            np.searchsorted(ids, np.concatenate([image.point_ids for image in images])),
            np.concatenate([_tangents(f.camera, i.xy) for f, i in zip(self._frames, images, strict=True)]),
            np.zeros(sum(counts)),
            np.array([cameras.index(image.camera_id) for image in images]),
            np.array([sum(camera.focal) / 2 for camera in lens_cameras]),
            np.zeros((len(images), ORDER, TWIST)),
            np.ones(len(images)),
        )
        self._seconds, self._columns = np.zeros(len(images)), np.zeros(len(images), bool)
        self.motions: dict[str, MeasuredMotion] = {}
        self._measure()

    def _measure(self, *, brief: bool = False) -> None:
        """Measure the motion of all frames with the present geometry and readouts; see `measure`."""
        self.motions = {}
        for number, frame in enumerate(self._frames):
            columns = bool(self._columns[number])
            motion = self._motion(number, float(self._seconds[number]), columns, brief=brief)
            if motion is not None:
                self.motions[frame.image] = motion

    def _motion(
        self, number: int, readout: float, columns: bool, *, brief: bool = False
    ) -> MeasuredMotion | None:
        """Measure the motion of a frame; see `measure` for ``brief``."""
        frame, geometry = self._frames[number], self._geometry
        if frame.tracks is None or not len(frame.points):
            return None
        points = geometry.points[frame.points] @ geometry.rotations[number].T + geometry.translations[number]
        flat = frame.tracks.reshape(-1, 2)
        known = np.isfinite(flat).all(axis=1)
        places = np.full(flat.shape, np.nan)
        places[known] = _tangents(frame.camera, flat[known])
        camera = self._seen.camera[number]
        zoom = geometry.zoom[camera]
        tracks = Tracks(
            points,
            places.reshape(frame.tracks.shape) / zoom,
            _shares(frame.tracks, frame.camera, columns),
            frame.times,
            float(self._seen.focal[camera] * zoom),
        )
        return measure(tracks, readout, brief=brief)

    def readouts(self) -> list[LensReadout]:
        """Return the readout times that hold, one per lens at most."""
        found = []
        for lens in dict.fromkeys(frame.lens for frame in self._frames):
            # The direction with the more certain readout is judged first, the other one if it does not hold.
            seen = {columns: self._good(lens, columns, 0.0) for columns in (False, True)}
            starts = {
                columns: fitted_readout(good, self._geometry)
                for columns, good in seen.items()
                if good is not None
            }
            tried = [(columns, *start) for columns, start in starts.items() if start is not None]
            for columns, start, _ in sorted(tried, key=lambda one: one[2] / abs(one[1].readout)):
                readout = self._readout(lens, columns, start.readout)
                if readout is not None and readout.holds:
                    found.append(
                        LensReadout(
                            lens=lens,
                            seconds=readout.seconds,
                            interval=readout.interval,
                            columns=columns,
                            still_px=readout.still_px,
                            rolled_px=readout.rolled_px,
                        )
                    )
                    break
        return found

    def _readout(self, lens: int, columns: bool, start: float) -> Readout | None:
        """Estimate the readout of a lens with speeds that are measured with the readout ``start``, s."""
        seen = self._good(lens, columns, start)
        return None if seen is None else estimate(seen, replace(self._geometry, readout=start))

    def _good(self, lens: int, columns: bool, readout: float) -> Observations | None:
        """Return the keypoints of the frames of a lens, with paths by ``readout``; None: too few are good."""
        motions = {}
        for n, frame in enumerate(self._frames):
            if frame.lens == lens and frame.two_sided:
                # Without a readout they are the motions that were measured at the start.
                motion = (
                    self._motion(n, readout, columns, brief=True)
                    if readout
                    else self.motions.get(frame.image)
                )
                if motion is not None:
                    motions[n] = motion
        if len(motions) < MIN_FRAMES:
            return None
        errors = [motion.error_px for motion in motions.values()]
        good = max(float(np.quantile(errors, GOOD)), MIN_ERROR_PX)
        trust = np.zeros(len(self._frames))
        for n, motion in motions.items():
            trust[n] = 1.0 / (1.0 + (motion.error_px / good) ** 2)
        seen = replace(self._with_paths(motions, columns), trust=trust).select(trust[self._seen.frame] > 0.0)
        every = max(1, len(seen.point) // MAX_OBSERVATIONS)
        # Kept-out points are every tenth one, so points are left out by another rule.
        return seen.select(seen.point // 16 % every == 0)

    def _with_paths(self, motions: Mapping[int, MeasuredMotion], columns: bool) -> Observations:
        paths = np.zeros_like(self._seen.paths)
        for number, motion in motions.items():
            paths[number] = motion.path
        return replace(self._seen, paths=paths, row=self._row(np.full(len(paths), columns)))

    def _row(self, columns: NDArray[np.bool_]) -> ArrayF64:  # [N] -> [M]
        rows = np.zeros(len(self._pixels))
        for number, frame in enumerate(self._frames):
            mine = self._seen.frame == number
            rows[mine] = _shares(self._pixels[mine], frame.camera, bool(columns[number]))
        return rows

    def roll(self, readouts: Sequence[LensReadout], *, poses: bool) -> None:
        """Adjust the geometry to the readouts, and measure the motions with them.

        Without ``poses``, only points change.
        """
        by_lens = {found.lens: found for found in readouts}
        known = [by_lens.get(frame.lens) for frame in self._frames]
        self._seconds = np.array([0.0 if found is None else found.seconds for found in known])
        self._columns = np.array([found is not None and found.columns for found in known])
        for _ in range(ROUNDS):
            self._measure(brief=True)
            numbers = {
                n: self.motions[f.image] for n, f in enumerate(self._frames) if f.image in self.motions
            }
            seen = self._with_paths(numbers, False)
            self._seen = replace(seen, row=self._row(self._columns) * self._seconds[seen.frame])
            start = replace(self._geometry, readout=1.0)  # rows are in seconds
            geometry = adjusted(self._seen, start, poses=poses)
            self._geometry = self._aligned(geometry) if poses else geometry
        self._measure()

    def _aligned(self, geometry: Geometry) -> Geometry:
        """Return ``geometry`` in the world of the model: no keypoint determines position, turn and scale."""
        found = pycolmap.estimate_sim3d(_marks(geometry), _marks(self._start))
        assert found is not None  # the four points of one camera determine a similarity
        turn, scale = found.rotation.matrix(), found.scale
        rotations = geometry.rotations @ turn.T
        translations = scale * geometry.translations - np.einsum("nij,j->ni", rotations, found.translation)
        points = scale * geometry.points @ turn.T + found.translation
        return replace(geometry, rotations=rotations, translations=translations, points=points)

    def model(self) -> tuple[SparseModel, NDArray[np.uint8]]:
        """Return the model with keypoints at their places at the middle row's time, and grey points."""
        geometry, seen = self._geometry, self._seen
        middle = replace(geometry, readout=0.0)
        moved = geometry.places(seen)[0] - middle.places(seen)[0]
        misses = geometry.misses(seen)
        counts = np.maximum(np.bincount(seen.point, minlength=len(geometry.points)), 1)
        error = np.bincount(seen.point, np.hypot(misses[:, 0], misses[:, 1]), len(geometry.points)) / counts
        images = {}
        for number, (key, image) in enumerate(sorted(self._model.images.items())):
            pose = Pose(geometry.rotations[number], geometry.translations[number])
            mine = seen.frame == number
            images[key] = replace(image, pose=pose, xy=image.xy - moved[mine])
        cameras = {
            key: _zoomed(self._model.cameras[key], float(geometry.zoom[number]))
            for number, key in enumerate(sorted(self._model.cameras))
        }
        model = replace(self._model, cameras=cameras, images=images, xyz=geometry.points, error=error)
        return model, np.zeros((len(model.xyz), 3), np.uint8)


def _marks(geometry: Geometry) -> ArrayF64:
    """Return per camera its centre and the points at the scene's size along its axes, [4 N, 3]."""
    centres = -np.einsum("nji,nj->ni", geometry.rotations, geometry.translations)
    size = np.linalg.norm(centres - centres.mean(axis=0), axis=1).max()
    axes = size * geometry.rotations
    return np.concatenate([centres, (centres[:, None] + axes).reshape(-1, 3)])


def _tangents(camera: Intrinsics, xy: ArrayF64) -> ArrayF64:  # [P, 2]
    return np.asarray(camera.colmap().cam_from_img(np.ascontiguousarray(xy)), np.float64).reshape(-1, 2)


def _shares(xy: ArrayF64, camera: Intrinsics, columns: bool) -> ArrayF64:  # [..., 2] px
    """Return the share of the readout at which pixels are read, -1/2 to 1/2."""
    side = camera.width if columns else camera.height
    return np.asarray(xy[..., 0 if columns else 1] / side - 0.5)


def _zoomed(camera: Intrinsics, zoom: float) -> Intrinsics:
    colmap = camera.colmap()
    params = colmap.params.copy()
    params[colmap.focal_length_idxs()] *= zoom
    return replace(camera, params=tuple(params.tolist()))


def _write_motions(path: Path, motions: Mapping[str, MeasuredMotion]) -> None:
    arrays: dict[str, ArrayF64] = {}
    for image, motion in motions.items():
        arrays[f"{image}.path"], arrays[f"{image}.covariance"] = motion.path, motion.covariance
        names = ("tracks", "error_px", "median_depth", "speed_px", "frame_s", "doubt")
        arrays[f"{image}.numbers"] = np.array([getattr(motion, name) for name in names], np.float64)
    with atomic_path(path) as temporary:
        np.savez(temporary, allow_pickle=False, **arrays)


if __name__ == "__main__":
    sys.exit(main())
