"""Motion of the camera at a chosen frame, measured from its neighbours in the video.

Keypoints that see sparse points are tracked from the frame into its neighbours, 1/30 s before and after. The
tracks and the known points give the path of the camera around the time of the frame. Speeds between chosen
frames, a fifth of a second apart, miss the tremor and the swings of a hand.

The path is a polynomial in time: at time t after the exposure of the frame's middle row, a point X in the
camera's axes is at R(w(t)) X + p(t), and (p, w)(t) is the sum of path[k - 1] t^k / k!.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cleargs.types import ArrayF32, ArrayF64, ImageU8

TWIST = 6
"""Numbers of a twist: translation of the scene past the camera along x, y, z, in world units, then its
rotation about x, y, z, in radians, in camera axes."""
ORDER = 4
"""Order of the path: its speed and three more derivatives, from two neighbours on each side."""
MAX_POINTS = 400
"""Maximum number of keypoints that are tracked in a frame."""
WINDOW, HALVINGS = (17, 17), 4
"""Window, px, and number of halvings of the image for the flow."""
RETURN_PX = 0.5
"""Maximum distance, px, between a keypoint and the end of its track into a neighbour and back."""
MIN_TRACKS = 20
"""Minimum number of tracks into a neighbour that counts."""
STEPS, LEAST_PX, SETTLED_PX = 8, 0.05, 0.01
"""Most reweighted steps of a fit, smallest scale of its weights, px, and motion of all tracks by a step, px,
below which it was the last one."""
SHARED_ERRORS = 250.0
"""Factor of the covariance for the errors that tracks share, such as those of the sparse points' depths. Chi
squared per number was 200 to 960 (medians) in five tuning rooms without it."""


@dataclass(frozen=True, eq=False)
class Tracks:
    """Keypoints of a frame and their places in its neighbours, as tangents of undistorted rays."""

    points: ArrayF64  # [P, 3] sparse points in the camera's axes
    places: ArrayF64  # [1 + K, P, 2] in the frame, then in its neighbours; NaN where a track is lost
    rows: ArrayF64  # [1 + K, P] time of the readout: -1/2 at the first row that is read, 1/2 at the last one
    times: ArrayF64  # [1 + K] s after the frame; 0 first
    focal: float
    """Pixels per unit of the tangents."""


@dataclass(frozen=True, eq=False)
class MeasuredMotion:
    """Path of a camera around the time of one frame."""

    path: ArrayF64  # [ORDER, 6] derivatives of the path, per s to the power of 1, 2, ...
    covariance: ArrayF64  # [6, 6] of the speed, per s squared
    tracks: int
    """Number of tracks into the neighbour with the fewest."""
    error_px: float
    """Median distance of the tracks from the path, px."""
    median_depth: float
    """Median depth of the tracked points, world units."""
    speed_px: float
    """Mean speed of the tracked points in the image, px per s."""
    frame_s: float
    """Time to the nearest neighbour, s."""
    doubt: float
    """Mean difference in the image, as a share of `speed_px`, of the speed without the farther neighbours. It
    is large where the camera moves back and forth between two frames of the video."""


def track(
    frame: ImageU8,  # [H, W] grey
    neighbours: Sequence[ImageU8],
    times: Sequence[float],  # times of the neighbours, s after the frame
    xy: ArrayF64,  # [P, 2] px; the centre of the first pixel is 0.5
) -> ArrayF64:  # [K, P, 2] px
    """Follow keypoints of a frame into its neighbours by pyramidal flow (Lucas and Kanade).

    Lost ones are NaN. The nearest neighbours are first. The flow into farther ones starts from theirs.
    """
    start = (xy - 0.5).astype(np.float32)
    found = np.full((len(neighbours), len(xy), 2), np.nan)
    for k in np.argsort(np.abs(times), kind="stable") if len(xy) else ():
        guess = start.copy()
        nearer = [n for n in range(len(times)) if 0 < times[n] / times[k] < 1]
        if nearer:
            n = max(nearer, key=lambda n: abs(times[n]))
            moved = (found[n] - xy) * (times[k] / times[n])
            guess += np.where(np.isfinite(moved), moved, 0.0).astype(np.float32)
        there = _flow(frame, neighbours[k], start, guess)
        back = _flow(neighbours[k], frame, there, start)
        height, width = neighbours[k].shape
        kept = np.linalg.norm(back - start, axis=1) < RETURN_PX
        kept &= ((there >= 0) & (there <= (width - 1, height - 1))).all(axis=1)
        found[k, kept] = there[kept].astype(np.float64) + 0.5
    return found


def _flow(one: ImageU8, other: ImageU8, xy: ArrayF32, guess: ArrayF32) -> ArrayF32:  # [P, 2]
    """Return the places of ``xy`` in ``other``; infinite where the flow finds none."""
    there, found, _ = cv2.calcOpticalFlowPyrLK(
        one, other, xy, guess.copy(), winSize=WINDOW, maxLevel=HALVINGS, flags=cv2.OPTFLOW_USE_INITIAL_FLOW
    )
    return np.where(np.asarray(found).reshape(-1, 1) > 0, np.asarray(there), np.inf).astype(np.float32)


def spread_out(xy: ArrayF64, at_most: int = MAX_POINTS) -> NDArray[np.int64]:
    """Return the numbers of at most ``at_most`` of ``xy`` [P, 2], evenly by their order along the rows."""
    order = np.lexsort((xy[:, 0], xy[:, 1]))
    return np.sort(order[np.linspace(0, len(xy) - 1, min(at_most, len(xy))).astype(np.int64)])


def measure(tracks: Tracks, readout: float = 0.0, *, brief: bool = False) -> MeasuredMotion | None:
    """Fit the path of the camera to ``tracks``; None if there are too few.

    A ``brief`` fit takes half of the time. Its doubt is 0, and its covariance has no part of it.

    The first and the last frame of a video have neighbours on one side, and so a path of second order.
    ``readout`` is the time, s, from the first row's exposure to the last one's.
    """
    counted = np.isfinite(tracks.places).all(axis=2).sum(axis=1)
    used = np.flatnonzero((counted >= MIN_TRACKS) & (tracks.times != 0.0))
    near = [side[np.argmin(np.abs(tracks.times[side]))] for side in _sides(tracks.times, used)]
    if not near:
        return None
    path, covariance, off = _fitted(tracks, used, readout)
    closer = path if brief else _fitted(tracks, np.sort(near), readout)[0]
    _, derivatives = projected(tracks.points, np.zeros((len(tracks.points), TWIST)))

    def in_image(speed: ArrayF64) -> float:
        """Return the mean speed of the points in the image, px per s."""
        moved = tracks.focal * np.einsum("pct,t->pc", derivatives, speed)
        return float(np.hypot(moved[:, 0], moved[:, 1]).mean())

    change, speed = path[0] - closer[0], in_image(path[0])
    return MeasuredMotion(
        path,
        covariance + np.outer(change, change),
        int(counted[used].min()),
        float(np.median(off)),
        float(np.median(tracks.points[:, 2])),
        speed,
        float(np.abs(tracks.times[near]).min()),
        in_image(change) / max(speed, 1e-12),
    )


def _sides(times: ArrayF64, used: NDArray[np.int64]) -> list[NDArray[np.int64]]:
    """Return the neighbours ``used`` before and after the frame; only sides that have some."""
    sides = used[times[used] < 0], used[times[used] > 0]
    return [side for side in sides if len(side)]


def _fitted(
    tracks: Tracks, used: NDArray[np.int64], readout: float
) -> tuple[ArrayF64, ArrayF64, ArrayF64]:  # [ORDER, 6], [6, 6], [M]
    """Return the path through the neighbours ``used``, the covariance of its speed, and the errors, px."""
    one_sided = len(_sides(tracks.times, used)) < 2
    order = min(2 if one_sided else ORDER, len(used))
    which, point = np.nonzero(np.isfinite(tracks.places[used]).all(axis=2))
    which = used[which]
    points = tracks.points[point]
    moved = tracks.focal * (tracks.places[which, point] - tracks.places[0, point])
    there = _powers(tracks.times[which] + readout * tracks.rows[which, point], order)
    here = _powers(readout * tracks.rows[0, point], order)
    path = np.zeros((order, TWIST))
    start, by_start = projected(points, np.zeros((len(points), TWIST)))
    for _ in range(STEPS):
        end, by_end = projected(points, np.einsum("mo,ot->mt", there, path))
        if readout:
            start, by_start = projected(points, np.einsum("mo,ot->mt", here, path))
        left = moved - tracks.focal * (end - start)
        slopes = there[:, None, :, None] * by_end[:, :, None] - here[:, None, :, None] * by_start[:, :, None]
        slopes = tracks.focal * slopes.reshape(2 * len(left), order * TWIST)
        squared = np.einsum("mc,mc->m", left, left)
        scale = max(LEAST_PX, 2.0 * float(np.median(np.sqrt(squared))))
        weight = 1.0 / (1.0 + squared / scale**2)  # Cauchy's
        weighted = np.repeat(weight, 2)[:, None] * slopes
        matrix = weighted.T @ slopes
        size = np.sqrt(np.maximum(matrix.diagonal(), 1e-300))
        inverse = np.linalg.inv(matrix / np.outer(size, size) + 1e-9 * np.eye(len(size)))
        inverse /= np.outer(size, size)
        side = weighted.T @ left.ravel()
        step = np.einsum("ab,b->a", inverse, side)
        path = path + step.reshape(order, TWIST)
        if np.abs(np.einsum("ma,a->m", slopes, step)).max() < SETTLED_PX:
            break
    freedom = max(1.0, 2.0 * float(weight.sum()) - order * TWIST)
    variance = SHARED_ERRORS * float((weight * squared).sum()) / freedom
    whole = np.zeros((ORDER, TWIST))
    whole[:order] = path
    return whole, variance * inverse[:TWIST, :TWIST], np.sqrt(squared)


def _powers(times: ArrayF64, order: int) -> ArrayF64:  # [M, order]
    return np.stack([times**k / math.factorial(k) for k in range(1, order + 1)], axis=1)


def path_at(paths: ArrayF64, times: ArrayF64) -> ArrayF64:  # [M, ORDER, 6], [M] s -> [M, 6]
    """Return the twists of ``paths`` at ``times`` after their frames."""
    return np.asarray(np.einsum("mo,mot->mt", _powers(times, ORDER), paths))


def speed_at(paths: ArrayF64, times: ArrayF64) -> ArrayF64:  # [M, ORDER, 6], [M] s -> [M, 6]
    """Return the derivative of `path_at` by the time, per s."""
    earlier = np.concatenate([np.ones((len(times), 1)), _powers(times, ORDER - 1)], axis=1)
    return np.asarray(np.einsum("mo,mot->mt", earlier, paths))


def projected(points: ArrayF64, twists: ArrayF64) -> tuple[ArrayF64, ArrayF64]:
    """Return the tangents [M, 2] of ``points`` [M, 3] after ``twists`` [M, 6], and their slopes [M, 2, 6]."""
    moved = Rotation.from_rotvec(twists[:, 3:]).apply(points) + twists[:, :3]
    depth = np.maximum(moved[:, 2], 1e-9)
    x, y, near, none = moved[:, 0] / depth, moved[:, 1] / depth, 1.0 / depth, np.zeros(len(depth))
    along_x = np.stack([near, none, -x * near, -x * y, 1.0 + x * x, -y], axis=1)
    along_y = np.stack([none, near, -y * near, -1.0 - y * y, x * y, x], axis=1)
    return np.stack([x, y], axis=1), np.stack([along_x, along_y], axis=1)


def in_other_units(motion: MeasuredMotion, factor: float) -> MeasuredMotion:
    """Return the motion in a world whose lengths are ``factor`` times as large."""
    units = np.array([factor] * 3 + [1.0] * 3)
    return replace(
        motion,
        path=motion.path * units,
        covariance=motion.covariance * np.outer(units, units),
        median_depth=motion.median_depth * factor,
    )
