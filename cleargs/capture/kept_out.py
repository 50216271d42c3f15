"""Matches that are kept out of adjustments, and measures of how well poses and cameras explain matches.

Poses and lenses explain the matches to which they were fitted better the more free parameters they have. Only
matches that were kept out of the fit show which of two fits is better.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from cleargs.capture.colmap import pycolmap
from cleargs.capture.prediction import Tracks

HELD_OUT = 10
"""Every tenth track is kept out."""
FIT_PX = 4.0
"""Distance from its epipolar line up to which a match fits the poses, px (as in COLMAP's verification)."""

_WITH_MATRIX = (
    pycolmap.TwoViewGeometryConfiguration.CALIBRATED,
    pycolmap.TwoViewGeometryConfiguration.UNCALIBRATED,
)
"""Kinds of pairs that determine a fundamental matrix: the scene is not a plane, and the camera moved."""

Pixels = NDArray[np.float64]  # [K, 2]
Matches = dict[tuple[int, int], tuple[Pixels, Pixels]]
"""Pair of image ids -> pixels in the first and in the second image, [K, 2] each."""


@dataclass(frozen=True, eq=False)
class KeptOut:
    """Matches and tracks that `keep_out` removed from a database."""

    matches: Matches
    tracks: Tracks
    """The tracks of the matches, without those that have two keypoints in a frame: some of their matches are
    wrong."""
    floor: float
    """Median distance, px, of the matches from the epipolar lines of the fundamental matrices that COLMAP
    fitted to each pair alone; 0 if no pair has a matrix. No poses explain the matches much better."""


def verified_matches(database: Path) -> Matches:
    """Return the matches in ``database`` that COLMAP verified."""
    with pycolmap.Database.open(database) as opened:
        pixels = pixels_in(opened)
        found = {pair: geometry.inlier_matches for pair, geometry in geometries_in(opened).items()}
    return {
        (one, two): (pixels[one][rows[:, 0]], pixels[two][rows[:, 1]])
        for (one, two), rows in found.items()
        if len(rows)
    }


def keep_out(database: Path, also: Tracks | None = None) -> KeptOut:
    """Remove every `HELD_OUT`-th track, and those with keypoints of ``also``, from the verified matches.

    A track is the set of features that matches connect. Its matches are kept out together, since any of them
    would help to fit its point.
    """
    kept_out: Matches = {}
    alone = [np.zeros(0)]
    with pycolmap.Database.open(database) as opened, pycolmap.DatabaseTransaction(opened):
        pixels, geometries = pixels_in(opened), geometries_in(opened)
        start, edges, tracks = _connected(pixels, geometries)
        sizes = [len(xy) for xy in pixels.values()]
        # Identified by its first feature, a track is the same in another database.
        first = np.unique(tracks, return_index=True)[1]
        owner = np.repeat(list(pixels), sizes)[first]
        number = first - np.array([start[key] for key in owner.tolist()], np.int64)
        # Wrong matches join tracks: a track with more features than there are images is not a real one.
        chosen = ((owner + number) % HELD_OUT == 0) & (np.bincount(tracks) <= len(pixels))
        if also is not None:
            known = also.keypoint < np.array([len(pixels[key]) for key in also.image.tolist()], np.int64)
            features = also.keypoint + np.array([start[key] for key in also.image.tolist()], np.int64)
            chosen[tracks[features[known]]] = True
        for (one, two), geometry in geometries.items():
            rows, out = np.asarray(geometry.inlier_matches), chosen[tracks[edges[one, two][:, 0]]]
            if out.any():
                xy = kept_out[one, two] = pixels[one][rows[out, 0]], pixels[two][rows[out, 1]]
                if geometry.config in _WITH_MATRIX and geometry.F is not None:
                    alone.append(_distances(*xy, geometry.F))
                geometry.inlier_matches = rows[~out]
                opened.update_two_view_geometry(one, two, geometry)
    errors = np.concatenate(alone)
    floor = float(np.median(errors)) if len(errors) else 0.0
    return KeptOut(kept_out, _unambiguous(pixels, tracks, chosen), floor)


def all_tracks(database: Path) -> Tracks:
    """Return the tracks of all verified matches in ``database``."""
    with pycolmap.Database.open(database) as opened:
        pixels, geometries = pixels_in(opened), geometries_in(opened)
    _, _, tracks = _connected(pixels, geometries)
    return _unambiguous(pixels, tracks, np.ones(tracks.max(initial=-1) + 1, bool))


def _connected(
    pixels: Mapping[int, Pixels], geometries: Mapping[tuple[int, int], pycolmap.TwoViewGeometry]
) -> tuple[dict[int, int], dict[tuple[int, int], NDArray[np.int64]], NDArray[np.int64]]:
    """Return the number of each image's first feature, the matches of each pair, and each feature's track.

    Matches are pairs of the numbers of features, which count over all images.
    """
    sizes = [len(xy) for xy in pixels.values()]
    start = dict(zip(pixels, np.cumsum([0, *sizes]).tolist(), strict=False))
    edges = {
        (one, two): np.reshape(geometry.inlier_matches, (-1, 2)).astype(np.int64)
        + np.array([start[one], start[two]])
        for (one, two), geometry in geometries.items()
    }
    a, b = np.concatenate([np.zeros((0, 2), np.int64), *edges.values()]).T
    graph = coo_array((np.ones(len(a)), (a, b)), shape=(sum(sizes),) * 2)
    return start, edges, connected_components(graph)[1]


def _unambiguous(
    pixels: Mapping[int, Pixels], tracks: NDArray[np.int64], chosen: NDArray[np.bool_]
) -> Tracks:
    """Return the ``chosen`` tracks of at least two features, without those with two features in an image."""
    images = np.repeat(np.array(list(pixels), np.int64), [len(xy) for xy in pixels.values()])
    numbers = np.concatenate([np.zeros(0, np.int64), *(np.arange(len(xy)) for xy in pixels.values())])
    members = np.flatnonzero((chosen & (np.bincount(tracks) > 1))[tracks])
    members = members[np.argsort(tracks[members], kind="stable")]
    shown, counts = np.unique(np.stack([tracks[members], images[members]]), axis=1, return_counts=True)
    members = members[~np.isin(tracks[members], shown[0, counts > 1])]
    places = np.concatenate([np.zeros((0, 2)), *pixels.values()])[members]
    return Tracks(images[members], tracks[members].astype(np.int64), numbers[members], places)


def epipolar_errors(
    matches: Matches,
    poses: Mapping[int, NDArray[np.float64]],  # image id -> world to camera, [3, 4]
    cameras: Mapping[int, pycolmap.Camera],  # by image id
) -> NDArray[np.float64]:
    """Return the distances of ``matches`` from their epipolar lines (Sampson error), px.

    It is infinite if a frame of the pair has no pose. Source: Hartley and Zisserman, Multiple View Geometry,
    2nd edition, equation 11.9.
    """
    found = [np.zeros(0)]
    for (one, two), (first, second) in matches.items():
        if one not in poses or two not in poses:
            found.append(np.full(len(first), np.inf))
            continue
        second_from_first = pycolmap.Rigid3d(poses[two]) * pycolmap.Rigid3d(poses[one]).inverse()
        essential = pycolmap.essential_matrix_from_pose(second_from_first)
        a, b = cameras[one], cameras[two]
        off = _distances(a.cam_from_img(first), b.cam_from_img(second), essential)
        focal = 0.5 * (a.mean_focal_length() + b.mean_focal_length())
        found.append(np.where(np.isfinite(off), off * focal, np.inf))
    return np.concatenate(found)


def fitting_shares(model: pycolmap.Reconstruction, matches: Matches) -> dict[int, float]:
    """Return the share of each placed image's ``matches`` that are within `FIT_PX` of their epipolar lines.

    A frame that wrong matches placed has a low share: its right matches contradict its pose.
    """
    poses = {key: image.cam_from_world().matrix() for key, image in model.images.items() if image.has_pose}
    cameras = {key: model.cameras[model.images[key].camera_id] for key in poses}
    counts, fitting = np.zeros((2, max(poses, default=0) + 1))
    for pair, pixels in matches.items():
        if poses.keys() >= set(pair):
            errors = epipolar_errors({pair: pixels}, poses, cameras)
            counts[list(pair)] += len(errors)
            fitting[list(pair)] += (errors < FIT_PX).sum()
    return {key: float(fitting[key] / counts[key]) for key in poses if counts[key]}


def weakest_join(model: pycolmap.Reconstruction, database: Path) -> tuple[int, float]:
    """Return the image with the weakest join to the images before it, and the share of matches that hold.

    Matches across a join are the verified ones between the earlier images and this or a later image. A match
    holds if both its features see the same point; if the two sides have different scales, they see two. Only
    features that see points count. The share is 1 if there are none.
    """
    points = {
        key: np.array([point.point3D_id for point in image.points2D], np.uint64)
        for key, image in model.images.items()
        if image.has_pose
    }
    counts, holding = np.zeros((2, max(points, default=0) + 1))
    with pycolmap.Database.open(database) as opened:
        geometries = geometries_in(opened)
    for (one, two), geometry in geometries.items():
        if one in points and two in points and len(geometry.inlier_matches):
            first, second = (points[key][geometry.inlier_matches[:, k]] for k, key in enumerate((one, two)))
            seen = (first != pycolmap.INVALID_POINT3D_ID) & (second != pycolmap.INVALID_POINT3D_ID)
            counts[one + 1 : two + 1] += seen.sum()
            holding[one + 1 : two + 1] += (seen & (first == second)).sum()
    share = np.divide(holding, counts, out=np.ones_like(counts), where=counts > 0)
    return int(share.argmin()), float(share.min())


def _distances(first: Any, second: Any, matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.sqrt(pycolmap.compute_squared_sampson_error(first, second, matrix))


def pixels_in(opened: pycolmap.Database) -> dict[int, Pixels]:
    images = sorted(image.image_id for image in opened.read_all_images())
    return {key: np.asarray(opened.read_keypoints(key), np.float64)[:, :2] for key in images}


def geometries_in(opened: pycolmap.Database) -> dict[tuple[int, int], pycolmap.TwoViewGeometry]:
    pair_ids, geometries = opened.read_two_view_geometries()
    return dict(zip(map(pycolmap.pair_id_to_image_pair, pair_ids), geometries, strict=True))
