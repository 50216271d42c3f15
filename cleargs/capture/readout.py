"""Readout time of a rolling shutter, from keypoints whose rows are known.

A keypoint is seen when its row is read. The pose of a frame is that of its middle row, and the measured path
of the camera (`cleargs.capture.motion`) gives the pose at any other row. The readout time is one unknown that
is adjusted together with all poses, points and focal lengths. Points are eliminated from each step (Schur
complement; Triggs et al., "Bundle Adjustment: A Modern Synthesis", 2000).

The rows of the sensor are rows of an upright picture, or columns where the camera was held sideways.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.spatial.transform import Rotation

from cleargs.capture.motion import TWIST, path_at, projected, speed_at
from cleargs.types import ArrayF64, MaskBool

KEPT_OUT = 10
"""Every tenth point takes no part in the fits and judges them."""
OUTLIER_PX, CAPPED_PX = 1.0, 4.0
"""Distance, px, from which an observation counts less (Cauchy's weights), and largest error in a mean."""
STEPS = 4
"""Steps of an adjustment. Poses and points fit each other before it."""
STRETCHES = 16
"""Stretches of frames whose errors count as independent of each other in the interval."""
DAMPING, POINT_DAMPING = 1e-8, 1e-6
WITHIN, SHARED = 2.0, 0.05
"""Standard errors on each side of an interval of 95 %, and share of the readout that is added on each side:
measured speeds of a whole capture can be off by it, since depths are those of the sparse points."""
MIN_GAIN, ALIKE = 0.01, 0.4
"""Least share of the mean error of the kept-out points that a readout explains, and largest difference of the
readouts of both halves of the frames, as a share of the readout of all (docs/motion.md)."""


@dataclass(frozen=True, eq=False)
class Observations:
    """Keypoints in frames, and the sparse points that they see."""

    frame: NDArray[np.int64]  # [M] number of the frame
    point: NDArray[np.int64]  # [M] number of the point
    tangents: ArrayF64  # [M, 2] of the undistorted rays
    row: ArrayF64  # [M] share of the readout: -1/2 at the first row, 1/2 at the last one
    camera: NDArray[np.int64]  # [N] number of the camera of each frame
    focal: ArrayF64  # [C] px per unit of the tangents
    paths: ArrayF64  # [N, ORDER, 6] of `MeasuredMotion`; 0 where none is known
    trust: ArrayF64  # [N] weight of the keypoints of each frame, 0 to 1

    def select(self, which: MaskBool) -> Observations:  # [M]
        """Return these observations alone."""
        chosen = {name: getattr(self, name)[which] for name in ("frame", "point", "tangents", "row")}
        return replace(self, **chosen)


@dataclass(frozen=True, eq=False)
class Geometry:
    """Poses of the middle rows, points and cameras."""

    rotations: ArrayF64  # [N, 3, 3] world to camera
    translations: ArrayF64  # [N, 3]
    points: ArrayF64  # [P, 3]
    zoom: ArrayF64  # [C] factor of the focal length of each camera
    readout: float = 0.0
    """Time from the first row to the last one, s."""

    def places(self, seen: Observations) -> tuple[ArrayF64, ArrayF64, ArrayF64]:
        """Return places [M, 2] px of the keypoints around the principal point, slopes [M, 2, 6], twists."""
        rotations, translations = self.rotations[seen.frame], self.translations[seen.frame]
        points = np.einsum("mij,mj->mi", rotations, self.points[seen.point]) + translations
        twists = path_at(seen.paths[seen.frame], self.readout * seen.row)
        place, slopes = projected(points, twists)
        focal = (self.zoom * seen.focal)[seen.camera[seen.frame]]
        return focal[:, None] * place, focal[:, None, None] * slopes, twists

    def misses(self, seen: Observations) -> ArrayF64:  # [M, 2]
        """Return the keypoints minus their places, px."""
        focal = seen.focal[seen.camera[seen.frame]]
        return np.asarray(focal[:, None] * seen.tangents - self.places(seen)[0])


@dataclass(frozen=True)
class Readout:
    """Readout time of a lens, by its frames in one video."""

    seconds: float
    """Negative if the last row (or column) is read first."""
    error: float
    """Standard error, s."""
    halves: tuple[float, float]
    """Readout times by the first and the second half of the frames, s."""
    still_px: float
    """Mean error of the kept-out points without a readout, px; each error counts at most `CAPPED_PX`."""
    rolled_px: float
    """Mean error with the readout, px."""

    @property
    def interval(self) -> tuple[float, float]:
        """Interval of 95 %, s."""
        reach = WITHIN * self.error + SHARED * abs(self.seconds)
        return self.seconds - reach, self.seconds + reach

    @property
    def holds(self) -> bool:
        """True if the kept-out points and both halves of the frames confirm that the shutter rolls."""
        one, other = self.halves
        alike = one * other > 0.0 and abs(one - other) <= ALIKE * abs(self.seconds)
        return alike and self.rolled_px <= (1.0 - MIN_GAIN) * self.still_px


def fitted_readout(seen: Observations, start: Geometry) -> tuple[Geometry, float] | None:
    """Return the geometry with the readout time that fits ``seen`` best, and its standard error, s.

    The frames share one lens and have measured paths. Returns None if the interval of 95 % contains zero.
    """
    fitted = seen.select(seen.point % KEPT_OUT != 0)
    rolled = adjusted(fitted, start, shutter=True)
    error = _Step(fitted, rolled, shutter=True).standard_error
    return None if abs(rolled.readout) <= WITHIN * error else (rolled, error)


def estimate(seen: Observations, start: Geometry) -> Readout | None:
    """Estimate the readout time as `fitted_readout`, and judge it by both halves and the kept-out points."""
    found = fitted_readout(seen, start)
    if found is None:
        return None
    rolled, error = found
    kept_out = seen.point % KEPT_OUT == 0
    fitted, judge = seen.select(~kept_out), seen.select(kept_out)
    still = adjusted(fitted, replace(start, readout=0.0))
    frames = np.unique(seen.frame)
    early = fitted.frame < frames[len(frames) // 2]
    first, second = (adjusted(fitted.select(half), rolled, shutter=True).readout for half in (early, ~early))
    return Readout(
        rolled.readout,
        error,
        (first, second),
        *(_mean_error(judge, geometry) for geometry in (still, rolled)),
    )


def adjusted(seen: Observations, start: Geometry, *, shutter: bool = False, poses: bool = True) -> Geometry:
    """Return points, with ``poses`` poses and zooms, and with ``shutter`` the readout, fitted to ``seen``."""
    geometry = start
    for _ in range(STEPS):
        geometry = _Step(seen, geometry, shutter=shutter, poses=poses).geometry
    return geometry


def _mean_error(seen: Observations, geometry: Geometry) -> float:
    """Return the mean error, px, of points that are placed by ``seen`` alone."""
    misses = adjusted(seen, geometry, poses=False).misses(seen)
    return float(np.minimum(np.hypot(misses[:, 0], misses[:, 1]), CAPPED_PX).mean())


class _Step:
    """One step of Gauss and Newton, with Cauchy's weights.

    Unknowns are six numbers of each pose, the logarithm of each zoom, the readout time, and the points.
    """

    def __init__(self, seen: Observations, geometry: Geometry, *, shutter: bool, poses: bool = True) -> None:
        self._seen, self._before, self._shutter, self._poses = seen, geometry, shutter, poses
        frames, points = len(geometry.rotations), len(geometry.points)
        place, slopes, twists = geometry.places(seen)
        misses = geometry.misses(seen)
        weight = 1.0 / np.sqrt(1.0 + np.einsum("mc,mc->m", misses, misses) / OUTLIER_PX**2)
        weight *= np.sqrt(seen.trust[seen.frame])
        self._misses = (weight[:, None] * misses).ravel()
        columns, values = [np.zeros((len(place), 0), np.int64)], [np.zeros((len(place), 2, 0))]
        if poses:
            columns += [TWIST * seen.frame[:, None] + np.arange(TWIST)]
            columns += [TWIST * frames + seen.camera[seen.frame][:, None]]
            values += [slopes, place[..., None]]
        self._others = TWIST * frames + len(geometry.zoom) if poses else 0
        if shutter:
            speeds = speed_at(seen.paths[seen.frame], geometry.readout * seen.row)
            columns += [np.full((len(place), 1), self._others)]
            values += [(np.einsum("mct,mt->mc", slopes, speeds) * seen.row[:, None])[..., None]]
        turned = Rotation.from_rotvec(twists[:, 3:]).as_matrix() @ geometry.rotations[seen.frame]
        of_points = weight[:, None, None] * np.einsum("mci,mij->mcj", slopes[:, :, :3], turned)
        self._cameras = _sparse(
            np.concatenate(columns, axis=1),
            weight[:, None, None] * np.concatenate(values, axis=2),
            self._others + int(shutter),
        )
        self._points = _sparse(3 * seen.point[:, None] + np.arange(3), of_points, 3 * points)
        blocks = np.zeros((points, 3, 3))
        np.add.at(blocks, seen.point, np.einsum("mca,mcb->mab", of_points, of_points))
        sizes = np.maximum(np.trace(blocks, axis1=1, axis2=2), 1e-12)
        inverses = np.linalg.inv(blocks + POINT_DAMPING * sizes[:, None, None] * np.eye(3))
        inverses[np.bincount(seen.point, minlength=points) < 2] = 0.0  # one ray gives no depth
        across = np.repeat(3 * np.arange(points), 3)[:, None] + np.arange(3)
        rows = np.broadcast_to(np.arange(3 * points)[:, None], across.shape)
        self._inverse = csr_array(
            (inverses.ravel(), (rows.ravel(), across.ravel())), shape=(3 * points, 3 * points)
        )
        self._mixed = csr_array(self._points.T @ self._cameras)

    @cached_property
    def _reduced(self) -> tuple[ArrayF64, ArrayF64]:
        """The equations without the points, scaled to a diagonal of ones, and the scales."""
        matrix = self._cameras.T @ self._cameras - self._mixed.T @ (self._inverse @ self._mixed)
        matrix = matrix.toarray()
        scales = np.sqrt(np.maximum(matrix.diagonal(), 1e-300))
        return matrix / np.outer(scales, scales) + DAMPING * np.eye(len(scales)), scales

    def _solved(self, side: ArrayF64, count: int) -> tuple[ArrayF64, ArrayF64]:
        """Return the first ``count`` unknowns of cameras, and the points, that explain ``side`` [2 M]."""
        points = self._inverse @ (self._points.T @ side)
        if not count:
            return np.zeros(0), np.asarray(points)
        matrix, scales = (array[..., :count] for array in self._reduced)
        mixed = self._mixed[:, :count]
        reduced = self._cameras[:, :count].T @ side - mixed.T @ points
        cameras = np.linalg.solve(matrix[:count], reduced / scales) / scales
        return cameras, np.asarray(points - self._inverse @ (mixed @ cameras))

    @property
    def geometry(self) -> Geometry:
        """The geometry after the step."""
        before = self._before
        cameras, points = self._solved(self._misses, self._cameras.shape[1])
        after = replace(before, points=before.points + points.reshape(-1, 3))
        if self._shutter:
            after = replace(after, readout=before.readout + float(cameras[-1]))
        if self._poses:
            frames = len(before.rotations)
            twists = cameras[: TWIST * frames].reshape(frames, TWIST)
            turns = Rotation.from_rotvec(twists[:, 3:]).as_matrix()
            translations = np.einsum("nij,nj->ni", turns, before.translations) + twists[:, :3]
            zoom = before.zoom * np.exp(cameras[TWIST * frames : self._others])
            rotations = turns @ before.rotations
            after = replace(after, rotations=rotations, translations=translations, zoom=zoom)
        return after

    @property
    def standard_error(self) -> float:
        """Standard error of the readout, s. Errors within each of `STRETCHES` may depend on each other."""
        slope = self._cameras[:, [self._others]].toarray().ravel()
        cameras, points = self._solved(slope, self._others)
        alone = slope - self._cameras[:, : self._others] @ cameras - self._points @ points
        frames = np.unique(self._seen.frame)
        stretch = np.searchsorted(frames, self._seen.frame) * STRETCHES // len(frames)
        products = np.add.reduce((alone * self._misses).reshape(-1, 2), axis=1)
        sums = np.bincount(stretch, products, minlength=STRETCHES)
        return float(np.sqrt(np.square(sums).sum()) / max(np.square(alone).sum(), 1e-300))


def _sparse(columns: NDArray[np.int64], values: ArrayF64, width: int) -> csr_array:
    """Return the matrix [2 M, width] with ``values`` [M, 2, U] in ``columns`` [M, U]."""
    rows = np.broadcast_to(np.arange(2 * len(values)).reshape(-1, 2, 1), values.shape)
    across = np.broadcast_to(columns[:, None], values.shape)
    return csr_array((values.ravel(), (rows.ravel(), across.ravel())), shape=(2 * len(values), width))
