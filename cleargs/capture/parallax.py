"""Does a capture show depth: what a homography leaves unexplained of the matches of distant frames.

A camera that turns or zooms on one spot, and any camera before a flat scene, relates each pair of frames by a
homography, whatever the focal lengths. Then no depth can be found.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from cleargs.capture.colmap import pycolmap
from cleargs.capture.kept_out import Pixels, geometries_in, pixels_in

_MOVES = 0.04, 0.25
"""Smallest and largest median motion of the matches of a pair that is judged, in long sides of the picture.
In pairs that are farther apart, more matches are those of a repeated pattern, or of one wall alone."""
_REPEATS = 0.35
"""Largest difference of a match from the median motion of its pair, in long sides. The next copy of a
repeated pattern is farther away, and would look like depth."""
_MATCHES, _PAIRS = 30, 4
"""Minimum number of matches per pair, and of pairs."""
_OFF_PX, _OFF = 1.5, 0.002
"""Distance from the homography from which a match is unexplained: the larger of px, and of long sides."""
_BENDS = (0.0, 0.15, -0.15, -0.3, -0.5)
"""Distortions that are tried: r / (1 + bend r²), r in half diagonals. The best one holds for all pairs."""
_PARALLAX, NO_DEPTH_BELOW, LITTLE_BELOW = 0.05, 0.08, 0.2
"""A pair shows depth if more than this share of its matches is unexplained. A capture shows none, or little,
if at most these shares of its pairs do. Observed: no pair of pans, zooms and flat scenes, 2 of 19 pairs of a
pan whose camera trembles by 1 cm, a third of the pairs of walks."""


def pairs_with_depth(database: Path) -> tuple[int, int]:
    """Return the number of pairs in ``database`` that show depth, and of those that are judged.

    Judged are each image's pairs with the smallest and the largest motion of `_MOVES`. Far views of a walk
    often share one wall only: of six walks of 24 frames, two showed no depth in the pairs with large motion.
    """
    with pycolmap.Database.open(database) as opened:
        pixels = pixels_in(opened)
        cameras = {camera.camera_id: camera for camera in opened.read_all_cameras()}
        size = {
            image.image_id: (cameras[image.camera_id].width, cameras[image.camera_id].height)
            for image in opened.read_all_images()
        }
        rows = {
            pair: np.asarray(geometry.inlier_matches, np.int64)
            for pair, geometry in geometries_in(opened).items()
            if len(geometry.inlier_matches) >= _MATCHES
        }
    found: dict[tuple[int, int], tuple[Pixels, Pixels]] = {}
    motion = {}
    for (one, two), matched in rows.items():
        first, second = pixels[one][matched[:, 0]], pixels[two][matched[:, 1]]
        moved = second - first
        near = np.linalg.norm(moved - np.median(moved, axis=0), axis=1) <= _REPEATS * max(size[two])
        if near.sum() >= _MATCHES:
            found[one, two] = first[near], second[near]
            motion[one, two] = float(np.median(np.linalg.norm(moved[near], axis=1))) / max(size[two])
    of_image: dict[int, list[tuple[float, tuple[int, int]]]] = {}
    for pair, length in motion.items():
        if _MOVES[0] <= length <= _MOVES[1]:
            for image in pair:
                of_image.setdefault(image, []).append((length, pair))
    shares = []
    for one, two in sorted({end(pairs)[1] for pairs in of_image.values() for end in (min, max)}):
        sides = *found[one, two], size[one], size[two]
        shares.append([_unexplained(*sides, bend) for bend in _BENDS])
    if len(shares) < _PAIRS:
        return len(shares), len(shares)
    of_bend = np.array(shares)
    best = of_bend[:, np.median(of_bend, axis=0).argmin()]
    return int((best > _PARALLAX).sum()), len(best)


def depth_share(database: Path) -> float:
    """Return the share of the judged pairs in ``database`` that show depth; 1 if too few can be judged."""
    deep, judged = pairs_with_depth(database)
    return 1.0 if judged < _PAIRS else deep / judged


def _unexplained(
    first: Pixels, second: Pixels, one: tuple[int, int], two: tuple[int, int], bend: float
) -> float:
    """Return the share of the matches that the best homography does not explain."""
    limit = max(_OFF_PX, _OFF * max(two))
    a, b = _straightened(first, one, bend), _straightened(second, two, bend)
    cv2.setRNGSeed(0)
    found = np.asarray(cv2.findHomography(a, b, cv2.RANSAC, limit, maxIters=300)[0])
    if found.shape != (3, 3):  # none was found
        return 1.0
    off = cv2.perspectiveTransform(a[:, None], found)[:, 0] - b
    return float((np.linalg.norm(off, axis=1) > limit).mean())


def _straightened(xy: Pixels, size: tuple[int, int], bend: float) -> Pixels:
    """Return pixels of a picture without the distortion ``bend`` of `_BENDS`."""
    middle = np.array(size) / 2
    radial = (xy - middle) / np.linalg.norm(middle)
    return np.asarray(middle + (xy - middle) / (1 + bend * (radial**2).sum(axis=1, keepdims=True)))
