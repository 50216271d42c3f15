"""Matches that agree with each other, but not with the cameras: a second motion, or frames in wrong places.

A screen of text that scrolls, or a train behind a window, moves by itself. If it covers much of the pictures,
mapping takes it, or a mixture of both motions, for the scene. Cameras that are 40 % off then predict 83 % of
the kept-out keypoints, since these are of matches that fit the stronger motion of their pair of frames. The
matches that contradict the cameras are many, and one homography explains them. If cameras are right, such
matches are few, and contradict each other.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from cleargs.capture.colmap import pycolmap
from cleargs.capture.kept_out import Pixels, epipolar_errors, pixels_in
from cleargs.sequences import spread

_APART, _MATCHES, _PAIRS, _MOST = 6, 60, 12, 240
"""Most frames from the first frame of a pair to its second, fewest matches of a pair that is judged; fewest
and most pairs."""
_OFF_PX, _OFF = 4.0, 1 / 80
"""Distance from the epipolar line from which a match contradicts the cameras: the larger of px, and of long
sides. A rolling shutter moves points by less."""
_AGREE_PX = 2.0  # distance up to which a match fits the homography
_CHANCE, _SHARE = 6, 0.02
"""Number of matches that fit some homography by chance, and share of a pair's matches that fit it besides."""


def second_motion(model: pycolmap.Reconstruction, database: Path) -> float:
    """Return the share of the judged pairs of frames that show a second motion; 0 if they are too few."""
    poses = {key: image.cam_from_world().matrix() for key, image in model.images.items() if image.has_pose}
    cameras = {key: model.cameras[model.images[key].camera_id] for key in poses}
    with pycolmap.Database.open(database) as opened:
        ids, matches = opened.read_all_matches()
        rows = {
            pycolmap.pair_id_to_image_pair(key): np.asarray(found)
            for key, found in zip(ids, matches, strict=True)
            if len(found) >= _MATCHES
        }
        pixels = pixels_in(opened)
    near = sorted(pair for pair in rows if abs(pair[0] - pair[1]) <= _APART and poses.keys() >= set(pair))
    judged = spread(near, _MOST)
    if len(judged) < _PAIRS:
        return 0.0
    moving = 0
    for one, two in judged:
        first, second = pixels[one][rows[one, two][:, 0]], pixels[two][rows[one, two][:, 1]]
        off = epipolar_errors({(one, two): (first, second)}, poses, cameras)
        limit = max(_OFF_PX, _OFF * max(cameras[two].width, cameras[two].height))
        agreeing = _agreeing(first[off > limit], second[off > limit])
        moving += agreeing - _CHANCE > _SHARE * len(first)
    return moving / len(judged)


def _agreeing(first: Pixels, second: Pixels) -> int:
    """Return the number of matches that one homography explains."""
    if len(first) <= _CHANCE:
        return 0
    cv2.setRNGSeed(0)
    _, fits = cv2.findHomography(first, second, cv2.RANSAC, _AGREE_PX, maxIters=500)
    return 0 if fits is None else int(np.count_nonzero(fits))
