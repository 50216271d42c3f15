"""Errors of poses and cameras at keypoints that took no part in their fit.

A kept-out track gets a point from its own keypoints, with the cameras as they are, and the distances of the
keypoints from this point's places in the images are the errors of the cameras. Each distance is multiplied by
sqrt(2 n / (2 n - 3)), since the point takes three numbers from the 2 n of a track of n keypoints. For a track
of two keypoints it is then the distance from the epipolar line.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cleargs.capture.colmap import pycolmap
from cleargs.types import ArrayF64

WITHIN_PX = 2.0
"""Distance up to which a keypoint counts as predicted, px of the working image."""
STEPS, OUTLIER_PX = 8, 2.0
"""Reweighted steps of a point, and distance from which a keypoint counts less (Cauchy's weights)."""
FAR, DAMPING = 1e3, 1e-12
"""Distance of a point without parallax, in sizes of the camera path, and the weight that holds it there."""
MIN_PARALLAX, MIN_TRACKS = 0.02, 20
"""Smallest angle, radians, between rays of a point that counts for the scale, and fewest such points."""
MAX_SCALE, WITHIN = 0.02, 2.0
"""Difference of the scales of two sides of a join that counts as none, and standard errors of an interval."""


@dataclass(frozen=True, eq=False)
class Tracks:
    """Keypoints of tracks, in the order of the tracks."""

    image: NDArray[np.int64]  # [M] image id
    track: NDArray[np.int64]  # [M] number of the track
    keypoint: NDArray[np.int64]  # [M] its number in the image
    xy: ArrayF64  # [M, 2] px


@dataclass(frozen=True, eq=False)
class _Rays:
    """Rays of keypoints by the cameras of a model."""

    directions: ArrayF64  # [M, 3] unit vectors in the world
    centres: ArrayF64  # [M, 3]
    focal: ArrayF64  # [M] px
    known: NDArray[np.bool_]  # [M] False where the lens has no ray

    def points(self, number: NDArray[np.int64]) -> ArrayF64:  # [M] sorted, from 0 on -> [T, 3]
        """Return the point of each track, fitted to the angles of its rays; ``number`` names their tracks."""
        counts = np.bincount(number)
        first = np.cumsum(counts) - counts
        size = max(float(np.ptp(self.centres, axis=0).max()), 1e-12)
        far = self.centres[first] + FAR * size * self.directions[first]
        across = np.eye(3) - self.directions[:, :, None] * self.directions[:, None, :]
        weight = self.known / size**2
        for _ in range(STEPS):
            matrix = np.add.reduceat(weight[:, None, None] * across, first)
            side = np.add.reduceat(weight[:, None] * np.einsum("mij,mj->mi", across, self.centres), first)
            hold = DAMPING * np.maximum(np.trace(matrix, axis1=1, axis2=2), 1e-300)[:, None]
            held = matrix + hold[:, :, None] * np.eye(3)
            points = np.linalg.solve(held, (side + hold * far)[..., None])[..., 0]
            offset = points[number] - self.centres
            distance = np.maximum(np.linalg.norm(offset, axis=1), 1e-12)
            off = self.focal * np.linalg.norm(np.einsum("mij,mj->mi", across, offset), axis=1) / distance
            weight = self.known / distance**2 / (1.0 + (off / OUTLIER_PX) ** 2)
        return np.asarray(points)


def _rays(tracks: Tracks, used: NDArray[np.int64], model: pycolmap.Reconstruction) -> _Rays:
    """Return the rays of the keypoints ``used``, whose images have poses."""
    image, xy = tracks.image[used], tracks.xy[used]
    rays, centres, focal = np.zeros((len(used), 3)), np.zeros((len(used), 3)), np.zeros(len(used))
    for key in np.unique(image).tolist():
        rows, shot = np.flatnonzero(image == key), model.images[key]
        camera = model.cameras[shot.camera_id]
        seen = np.asarray(camera.cam_ray_from_img(np.ascontiguousarray(xy[rows])))
        rays[rows] = seen @ shot.cam_from_world().rotation.matrix()
        centres[rows], focal[rows] = shot.projection_center(), camera.mean_focal_length()
    known = np.asarray(np.isfinite(rays).all(axis=1))
    return _Rays(np.where(known[:, None], rays, 0.0), centres, focal, known)


def _several(tracks: Tracks, among: NDArray[np.bool_]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the keypoints ``among`` [M] whose track has two of them, and the numbers of their tracks."""
    _, number, counts = np.unique(tracks.track[among], return_inverse=True, return_counts=True)
    used = np.flatnonzero(among)[counts[number] >= 2]
    return used, np.unique(tracks.track[used], return_inverse=True)[1]


def _placed(tracks: Tracks, model: pycolmap.Reconstruction) -> NDArray[np.bool_]:
    return np.isin(tracks.image, [key for key, image in model.images.items() if image.has_pose])


def prediction_errors(tracks: Tracks, model: pycolmap.Reconstruction) -> ArrayF64:  # [M] px
    """Return the distance of each keypoint from its place by the cameras of ``model``.

    It is NaN if the frame has no pose or no other frame with a pose has a keypoint of the track, and infinite
    if the point is behind the camera.
    """
    errors = np.full(len(tracks.track), np.nan)
    used, number = _several(tracks, _placed(tracks, model))
    if not len(used):
        return errors
    points, counts = _rays(tracks, used, model).points(number), np.bincount(number)
    freedom = np.sqrt(2 * counts / (2 * counts - 3))[number]
    for key in np.unique(tracks.image[used]).tolist():
        rows, shot = np.flatnonzero(tracks.image[used] == key), model.images[key]
        pose = shot.cam_from_world()
        there = points[number[rows]] @ pose.rotation.matrix().T + pose.translation
        places = np.asarray(model.cameras[shot.camera_id].img_from_cam(there)).reshape(-1, 2)
        off = np.asarray(np.linalg.norm(places - tracks.xy[used[rows]], axis=1))
        errors[used[rows]] = np.where(np.isfinite(off), freedom[rows] * off, np.inf)
    return errors


def scales_differ(tracks: Tracks, model: pycolmap.Reconstruction, start: int) -> bool:
    """Return True if the images before id ``start`` and the others have different scales.

    That is, if the interval of 95 % of `_scale_across` is farther from 0 than `MAX_SCALE`.
    """
    scale, error = _scale_across(tracks, model, start)
    return abs(scale) - WITHIN * error > MAX_SCALE


def scales_agree(tracks: Tracks, model: pycolmap.Reconstruction, start: int) -> bool:
    """Return True if the images before id ``start`` and the others have the same scale.

    That is, if the interval of 95 % of `_scale_across` is nearer to 0 than `MAX_SCALE`.
    """
    scale, error = _scale_across(tracks, model, start)
    return abs(scale) + WITHIN * error <= MAX_SCALE


def _scale_across(tracks: Tracks, model: pycolmap.Reconstruction, start: int) -> tuple[float, float]:
    """Return the scale of the images from id ``start`` on over that before, and its standard error.

    Both are logarithms. Tracks across this join get a point from each side alone. The scale is the median
    ratio of the distances of these points from the join's camera. The error is infinite if there are fewer
    than `MIN_TRACKS`.
    """
    placed = _placed(tracks, model)
    join = min((key for key, image in model.images.items() if image.has_pose and key >= start), default=None)
    if join is None:
        return 0.0, math.inf
    joint = model.images[join].projection_center()
    before, after = placed & (tracks.image < start), placed & (tracks.image >= start)
    across = np.isin(tracks.track, np.intersect1d(tracks.track[before], tracks.track[after]))
    found: list[dict[int, float]] = []
    for among in (before & across, after & across):
        used, number = _several(tracks, among)
        if not len(used):
            return 0.0, math.inf
        rays = _rays(tracks, used, model)
        points = rays.points(number)
        mean = np.add.reduceat(rays.directions, np.cumsum(np.bincount(number)) - np.bincount(number))
        mean /= np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-12)
        angles = np.arccos(np.clip(np.einsum("mi,mi->m", rays.directions, mean[number]), -1.0, 1.0))
        wide = np.zeros(len(points))
        np.maximum.at(wide, number, angles)
        names = np.unique(tracks.track[used])
        distance = np.log(np.maximum(np.linalg.norm(points - joint, axis=1), 1e-12))
        good = 2.0 * wide >= MIN_PARALLAX
        found.append(dict(zip(names[good].tolist(), distance[good].tolist(), strict=True)))
    both = sorted(found[0].keys() & found[1].keys())
    if len(both) < MIN_TRACKS:
        return 0.0, math.inf
    ratios = np.array([found[1][key] - found[0][key] for key in both])
    middle = float(np.median(ratios))
    spread = 1.4826 * float(np.median(np.abs(ratios - middle)))
    return middle, 1.2533 * spread / math.sqrt(len(ratios))  # standard error of a median
