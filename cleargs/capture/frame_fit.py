"""The change of a frame's camera that its keypoints ask for, while the points stay; and if its halves agree.

The upper and the lower half of a picture see the scene at the same time and from the same place, unless a
shutter rolls, a part moves by itself, or the lens is another one. Then the two halves ask for different
poses, although the pose of the whole explains most keypoints within 2 px.
"""

from __future__ import annotations

import numpy as np

from cleargs.capture.colmap import pycolmap
from cleargs.capture.motion import TWIST, projected
from cleargs.sequences import spread
from cleargs.types import ArrayF64

MIN_KEYPOINTS, HALVED_FRAMES, AHEAD = 30, 60, 0.2
"""Fewest keypoints of a frame that counts; most frames, evenly spread, whose halves are compared; and least
cosine of the angle off the axis of their keypoints: the slopes are those of a perspective lens."""


def misses_of(
    model: pycolmap.Reconstruction, image: pycolmap.Image
) -> tuple[ArrayF64, ArrayF64, ArrayF64]:  # [M, 3], [M, 2], [M, 2]
    """Return the points of ``image`` in its camera's axes, their keypoints, and by how much they miss, px."""
    camera, pose = model.cameras[image.camera_id], image.cam_from_world()
    seen = image.get_observation_points2D()
    points = np.array([model.points3D[keypoint.point3D_id].xyz for keypoint in seen])
    points = points @ pose.rotation.matrix().T + pose.translation
    xy = np.array([keypoint.xy for keypoint in seen])
    return points, xy, xy - np.asarray(camera.img_from_cam(points)).reshape(-1, 2)


def slopes_of(points: ArrayF64, focal: float) -> tuple[ArrayF64, ArrayF64]:
    """Return the tangents [M, 2] of ``points``, and how the pixels move with the pose, [M, 2, 6].

    The first three are shifts of the camera's axes, the last three turns.
    """
    place, slopes = projected(points, np.zeros((len(points), TWIST)))
    return place, focal * slopes


def robust_step(slopes: ArrayF64, misses: ArrayF64, scale: float = 1.0) -> tuple[ArrayF64, ArrayF64]:
    """Return the step [A] that lowers ``misses`` [M, 2] most, and its covariance [A, A].

    ``slopes`` [M, 2, A] are px per unit of the step. Misses above ``scale``, px, count less, by
    Cauchy's weights.
    """
    weight = 1.0 / (1.0 + np.einsum("mc,mc->m", misses, misses) / scale**2)
    matrix = np.einsum("mca,m,mcb->ab", slopes, weight, slopes)
    size = np.sqrt(np.maximum(matrix.diagonal(), 1e-300))
    inverse = np.linalg.inv(matrix / np.outer(size, size) + 1e-9 * np.eye(len(size))) / np.outer(size, size)
    step = inverse @ np.einsum("mca,m,mc->a", slopes, weight, misses)
    left = misses - slopes @ step
    variance = np.einsum("mc,m,mc->", left, weight, left) / max(1.0, 2.0 * weight.sum() - len(step))
    return step, variance * inverse


def halves_apart(model: pycolmap.Reconstruction) -> float:
    """Return how far apart the upper and the lower half of the pictures place the camera; 0 if they agree.

    It is the median over the frames, a share of the mean distance of the camera centres from their mean.
    The part that the uncertainty of the two places explains is taken off.
    """
    placed = [image for _, image in sorted(model.images.items()) if image.has_pose]
    centres = np.array([image.projection_center() for image in placed])
    size = max(float(np.linalg.norm(centres - centres.mean(axis=0), axis=1).mean()), 1e-12)
    squares = []
    rich = [image for image in placed if image.num_points3D >= 2 * MIN_KEYPOINTS]
    for image in spread(rich, HALVED_FRAMES):
        points, xy, misses = misses_of(model, image)
        ahead = points[:, 2] > AHEAD * np.linalg.norm(points, axis=1)
        if ahead.sum() < 2 * MIN_KEYPOINTS:
            continue
        points, xy, misses = points[ahead], xy[ahead], misses[ahead]
        _, slopes = slopes_of(points, model.cameras[image.camera_id].mean_focal_length())
        upper, scale = xy[:, 1] < np.median(xy[:, 1]), max(1.0, float(np.median(np.abs(misses))))
        halves = (robust_step(slopes[half], misses[half], scale) for half in (upper, ~upper))
        (one, one_error), (two, two_error) = halves
        away = one[:3] - two[:3]
        squares.append(away @ away - np.trace(one_error[:3, :3] + two_error[:3, :3]))
    return float(np.sqrt(max(0.0, np.median(squares)))) / size if squares else 0.0
