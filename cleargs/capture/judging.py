"""Matches that no adjustment sees, and how well poses and cameras explain them.

Poses and lenses that were fitted to matches explain these matches better the more free numbers they have.
Only matches that took no part show the better one of two fits.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from cleargs.capture.colmap import pycolmap

HELD_OUT = 10
"""Every tenth track is kept out."""

CAPPED_PX = 4.0
"""Errors count up to this: COLMAP takes a match for right within 4 px of its epipolar line."""

_WITH_MATRIX = (
    pycolmap.TwoViewGeometryConfiguration.CALIBRATED,
    pycolmap.TwoViewGeometryConfiguration.UNCALIBRATED,
)
"""Pairs whose matches fix a fundamental matrix: the scene is not a plane, and the camera moved."""

Matches = dict[tuple[int, int], tuple[NDArray[np.float64], NDArray[np.float64]]]
"""Pair of image ids -> pixels in the first and in the second image, [K, 2] each."""


def verified_matches(database: Path) -> Matches:
    """Return the matches in ``database`` that COLMAP verified."""
    with pycolmap.Database.open(database) as opened:
        pixels = {
            image.image_id: np.asarray(opened.read_keypoints(image.image_id), np.float64)[:, :2]
            for image in opened.read_all_images()
        }
        pair_ids, geometries = opened.read_two_view_geometries()
    found: Matches = {}
    for pair_id, geometry in zip(pair_ids, geometries, strict=True):
        one, two = pycolmap.pair_id_to_image_pair(pair_id)
        rows = np.asarray(geometry.inlier_matches)
        if len(rows):
            found[one, two] = pixels[one][rows[:, 0]], pixels[two][rows[:, 1]]
    return found


def keep_out(database: Path) -> tuple[Matches, float]:
    """Remove every `HELD_OUT`-th track from the verified matches in ``database``.

    A track is all features that matches connect. Its matches are kept out together: else the others would
    give its point away.

    Returns:
        The matches that were removed, and their median distance, px, from the lines of the fundamental
        matrices that COLMAP fitted to each pair alone: no poses explain them much better. It is 0 where no
        pair has one.
    """
    kept_out: Matches = {}
    alone = []
    with pycolmap.Database.open(database) as opened, pycolmap.DatabaseTransaction(opened):
        images = sorted(image.image_id for image in opened.read_all_images())
        pixels = {key: np.asarray(opened.read_keypoints(key), np.float64)[:, :2] for key in images}
        start = dict(zip(images, np.cumsum([0, *(len(pixels[key]) for key in images)]), strict=False))
        pair_ids, geometries = opened.read_two_view_geometries()
        pairs = [pycolmap.pair_id_to_image_pair(pair_id) for pair_id in pair_ids]
        rows = [np.asarray(geometry.inlier_matches, np.int64).reshape(-1, 2) for geometry in geometries]
        edges = [
            row + np.array([start[one], start[two]]) for row, (one, two) in zip(rows, pairs, strict=True)
        ]
        tracks = _tracks(edges, sum(map(len, pixels.values())))
        sizes = np.bincount(tracks)
        first = np.unique(tracks, return_index=True)[1]  # by which a track is the same in another database
        owner = np.repeat(images, [len(pixels[key]) for key in images])[first]
        number = first - np.array([start[key] for key in owner.tolist()], np.int64)
        # Wrong matches join tracks: one of more features than there are images is none.
        chosen = ((owner + number) % HELD_OUT == 0) & (sizes <= len(images))
        for geometry, row, edge, (one, two) in zip(geometries, rows, edges, pairs, strict=True):
            out = chosen[tracks[edge[:, 0]]]
            if out.any():
                kept_out[one, two] = first_xy, second_xy = pixels[one][row[out, 0]], pixels[two][row[out, 1]]
                if geometry.config in _WITH_MATRIX and geometry.F is not None:
                    alone.append(_sampson(_homogeneous(first_xy), _homogeneous(second_xy), geometry.F))
                geometry.inlier_matches = row[~out].astype(np.uint32)
                opened.update_two_view_geometry(one, two, geometry)
    return kept_out, float(np.median(np.concatenate(alone))) if alone else 0.0


def _tracks(edges: list[NDArray[np.int64]], features: int) -> NDArray[np.int64]:
    """Return the number of the track of each feature; ``edges`` are pairs of features."""
    a, b = np.concatenate([np.zeros((0, 2), np.int64), *edges]).T
    _, labels = connected_components(coo_array((np.ones(len(a)), (a, b)), shape=(features, features)))
    return np.asarray(labels, np.int64)


def epipolar_errors(
    matches: Matches,
    poses: Mapping[int, NDArray[np.float64]],  # image id -> world to camera, [3, 4]
    cameras: Mapping[int, pycolmap.Camera],  # by image id
) -> NDArray[np.float64]:
    """Return the distances of ``matches`` from their epipolar lines (Sampson error), px.

    They are infinite where a frame has no pose. Source: Hartley and Zisserman, Multiple View Geometry, 2nd
    edition, equation 11.9.
    """
    found = [np.zeros(0)]
    for (one, two), (first, second) in matches.items():
        if one not in poses or two not in poses:
            found.append(np.full(len(first), np.inf))
            continue
        a, b = poses[one], poses[two]
        rotation = b[:, :3] @ a[:, :3].T
        x, y, z = b[:, 3] - rotation @ a[:, 3]
        essential = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ rotation
        off = _sampson(_rays(cameras[one], first), _rays(cameras[two], second), essential)
        focal = 0.5 * (cameras[one].mean_focal_length() + cameras[two].mean_focal_length())
        found.append(np.where(np.isfinite(off), off * focal, np.inf))
    return np.concatenate(found)


def _sampson(
    p: NDArray[np.float64],  # [K, 3] points of the first image
    q: NDArray[np.float64],  # [K, 3] of the second
    matrix: NDArray[np.float64],  # [3, 3], q^T matrix p = 0
) -> NDArray[np.float64]:
    to_second, to_first = p @ matrix.T, q @ matrix
    weight = (to_second[:, :2] ** 2).sum(axis=1) + (to_first[:, :2] ** 2).sum(axis=1)
    return np.asarray(np.abs((q * to_second).sum(axis=1)) / np.sqrt(np.maximum(weight, 1e-300)))


def _rays(camera: pycolmap.Camera, xy: NDArray[np.float64]) -> NDArray[np.float64]:  # [K, 2] -> [K, 3]
    return _homogeneous(np.asarray(camera.cam_from_img(xy)))


def _homogeneous(xy: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.column_stack([xy, np.ones(len(xy))])
