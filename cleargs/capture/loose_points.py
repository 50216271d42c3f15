"""Points of an input that none of its images observes: those of laser scanners, and of RealityScan.

Gaussians start from them. Nothing else uses them, because it is unknown which frames see them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from cleargs.capture.cameras import Similarity
from cleargs.capture.model import SparseModel

MOST = 8_000
"""Maximum number of points that are used. They take the places of points that a training would guess
(`g0.min_points`). With more, no Gaussians would be left for the growth where it is needed."""

SPACINGS, APART = 2.0, 0.02
"""Largest median distance of a triangulated point from the next loose one: in median distances of loose
points from each other, or as a share of its distance from the nearest camera. Beyond both, they are not of
this place or not in this world."""


@dataclass(frozen=True)
class LoosePoints:
    """Positions and colours of points."""

    xyz: NDArray[np.float64]  # [N, 3]
    rgb: NDArray[np.uint8]  # [N, 3] sRGB

    def select(self, which: NDArray[np.generic]) -> LoosePoints:
        return LoosePoints(self.xyz[which], self.rgb[which])


def in_scene(points: LoosePoints, similarity: Similarity, model: SparseModel) -> LoosePoints | None:
    """Return the points in the world of ``model``: at most `MOST` of those in view of two images, evenly.

    ``similarity`` leads from the input's world to that of ``model``. None is returned if they are not where
    the images show surfaces.
    """
    moved = LoosePoints(similarity.points(points.xyz), points.rgb)
    views = np.zeros(len(moved.xyz), np.int64)
    for image in model.images.values():
        camera = model.cameras[image.camera_id]
        rays = moved.xyz @ image.pose.rotation.T + image.pose.translation
        ahead = np.flatnonzero(rays[:, 2] > 0)
        xy = rays[ahead, :2] / rays[ahead, 2:] * camera.focal + camera.centre
        views[ahead[((xy >= 0) & (xy < (camera.width, camera.height))).all(axis=1)]] += 1
    inside = np.flatnonzero(views >= 2)
    if len(inside) < 2:
        return None
    found = moved.select(inside[np.unique(np.linspace(0, len(inside) - 1, MOST).round().astype(np.int64))])
    centres = np.array([-image.pose.rotation.T @ image.pose.translation for image in model.images.values()])
    tree = KDTree(found.xyz)
    spacing = float(np.median(tree.query(found.xyz, k=2)[0][:, 1]))
    off, depth = tree.query(model.xyz)[0], KDTree(centres).query(model.xyz)[0]
    return found if np.median(off / np.maximum(SPACINGS * spacing, APART * depth)) <= 1 else None
