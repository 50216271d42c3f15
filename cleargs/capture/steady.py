"""Stabilised video: the stabiliser cuts each frame out of the picture at another place.

Poses and one lens do not explain that the centre of the picture moves. The residuals of such frames shrink by
a shift of the whole frame much more than by another zoom and distortion, as blur and other faults do not.
"""

from __future__ import annotations

import copy
from collections.abc import Callable

import numpy as np

from cleargs.capture.colmap import pycolmap
from cleargs.types import ArrayF64

_EXPLAINED, _TWICE = 0.1, 2.0
"""Minimum share of the squared residuals that a shift explains in the median frame, and how many times the
share of two other terms it is. Observed: 0.21 and more for stabilised rooms, at most 0.02 for others."""
_BETTER = 0.85  # the shifts are accepted if they lower the mean reprojection error to at most this share
_ROUNDS, _STRIDE = 6, 1.5
"""Rounds of shifts and adjustment, and factor of each shift: the points follow only in part."""
_POINTS, _FRAMES, _OUTLIER = 20, 6, 3.0
"""Minimum number of points of a frame, and of frames; residuals above this many medians do not count."""

Shifts = dict[int, ArrayF64]
"""Image id -> shift of its picture, [2] px."""


def steadied(
    model: pycolmap.Reconstruction, adjust: Callable[[pycolmap.Reconstruction], None]
) -> tuple[pycolmap.Reconstruction, Shifts]:
    """Return ``model`` and the shift of each frame; the same model and no shifts if they do not move.

    ``adjust`` adjusts poses, points and lens of a model. The shifts have no mean: the lens holds it.
    """
    found, moves = _shifts(model)
    if not moves:
        return model, {}
    steady, total = copy.deepcopy(model), {key: np.zeros(2) for key in model.images}
    for _ in range(_ROUNDS):
        mean = np.mean(list(found.values()), axis=0)
        _move(steady, {key: -_STRIDE * (shift - mean) for key, shift in found.items()})
        total = {
            key: total[key] + _STRIDE * (found[key] - mean) if key in found else total[key] for key in total
        }
        adjust(steady)
        steady.update_point_3d_errors()
        found, _ = _shifts(steady)
    before, after = model.compute_mean_reprojection_error(), steady.compute_mean_reprojection_error()
    if after > _BETTER * before:
        return model, {}
    _move(steady, total)
    return steady, total


def _move(model: pycolmap.Reconstruction, shifts: Shifts) -> None:
    for key, shift in shifts.items():
        for point in model.images[key].points2D:
            point.xy = point.xy + shift


def _shifts(model: pycolmap.Reconstruction) -> tuple[Shifts, bool]:
    """Return the shift that lowers the residuals of each frame most, and True if the frames are shifted."""
    found, shares = {}, []
    for key, image in model.images.items():
        seen = [point for point in image.points2D if point.has_point3D()] if image.has_pose else []
        if len(seen) < _POINTS:
            continue
        camera, pose = model.cameras[image.camera_id], image.cam_from_world().matrix()
        rays = np.stack([model.points3D[point.point3D_id].xyz for point in seen]) @ pose[:, :3].T + pose[:, 3]
        off = np.stack([point.xy for point in seen]) - np.asarray(camera.img_from_cam(rays)).reshape(-1, 2)
        length = np.linalg.norm(off, axis=1)
        kept = length <= _OUTLIER * np.median(length)
        by_pose, by_shift, by_zoom = _terms(rays[kept], camera.mean_focal_length())
        start, left, control = (
            _solved(np.concatenate(terms, axis=1), off[kept].ravel())
            for terms in ([by_pose], [by_pose, by_shift], [by_pose, by_zoom])
        )
        found[key] = left[0][-2:]
        shares.append((1 - left[1] / start[1], 1 - control[1] / start[1]))
    if len(shares) < _FRAMES:
        return found, False
    shift, control_share = np.median(shares, axis=0)
    return found, bool(shift > max(_EXPLAINED, _TWICE * control_share))


def _solved(terms: ArrayF64, off: ArrayF64) -> tuple[ArrayF64, float]:
    """Return the factors of ``terms`` [2 K, N] that explain ``off`` [2 K], and the squares that are left."""
    factors = np.asarray(np.linalg.lstsq(terms, off, rcond=None)[0], np.float64)
    return factors, max(float(((off - terms @ factors) ** 2).sum()), 1e-12)


def _terms(rays: ArrayF64, focal: float) -> tuple[ArrayF64, ArrayF64, ArrayF64]:
    """Return the motion [2 K, N] of pixels with ``rays`` [K, 3] per unit of pose, of shift, and of zoom."""
    z = rays[:, 2]
    u, v = rays[:, 0] / z, rays[:, 1] / z
    none, one = np.zeros_like(u), np.ones_like(u)
    radial = u * u + v * v
    across = [one / z, none, -u / z, -u * v, 1 + u * u, -v]
    down = [none, one / z, -v / z, -1 - v * v, u * v, u]
    pose = focal * np.stack([np.stack(across, 1), np.stack(down, 1)], 1).reshape(-1, 6)
    shift = np.tile(np.eye(2), (len(u), 1))
    zoom = focal * np.stack([np.stack([u, u * radial], 1), np.stack([v, v * radial], 1)], 1).reshape(-1, 2)
    return pose, shift, zoom
