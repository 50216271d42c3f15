"""Cameras that all look the same way: their pictures leave the focal length open.

Another focal length with other depths along the view gives the same pictures, also if the cameras roll about
it. Adjustments then end anywhere: at three times the focal length in a flight straight down.
"""

from __future__ import annotations

import copy

import numpy as np

from cleargs.capture.adjustment import adjust_all, set_lens
from cleargs.capture.camera_models import FIRST_LENS
from cleargs.capture.colmap import pycolmap
from cleargs.types import ArrayF64

TURNED = np.radians(2.0)
"""Smallest turn of the views (`turned`) that shows the focal length."""
USUAL_FOCAL = 0.75
"""Focal length, in long sides, that is assumed: those of phones and drones are 0.67 to 0.78."""


def turned(model: pycolmap.Reconstruction) -> float:
    """Return the root mean square angle, radians, between the views of the cameras and their mean."""
    views = _views(model)
    return float(np.sqrt(np.mean(np.arccos(np.clip(views @ _mean(views), -1.0, 1.0)) ** 2)))


def refocused(model: pycolmap.Reconstruction, focal: float) -> pycolmap.Reconstruction:
    """Return ``model``, whose cameras look the same way, adjusted with the focal length ``focal``, px."""
    other = copy.deepcopy(model)
    set_lens(other, FIRST_LENS)
    (camera,) = other.cameras.values()
    factor = focal / camera.mean_focal_length()
    params = camera.params.copy()
    params[0], params[3] = focal, params[3] * factor**2
    camera.params = params
    view = _mean(_views(model))
    placed = [image for image in other.images.values() if image.has_pose]
    middle = np.mean([image.projection_center() for image in placed], axis=0)
    for image in placed:
        turn = image.cam_from_world().rotation.matrix()
        centre = image.projection_center()
        centre = centre + (factor - 1.0) * (view @ (centre - middle)) * view
        pose = np.column_stack([turn, -turn @ centre])
        other.frames[image.frame_id].rig_from_world = pycolmap.Rigid3d(pose)
    for point in other.points3D.values():
        point.xyz = point.xyz + (factor - 1.0) * (view @ (point.xyz - middle)) * view
    adjust_all(other, focal=False)
    other.update_point_3d_errors()
    return other


def _views(model: pycolmap.Reconstruction) -> ArrayF64:  # [N, 3]
    images = [image for image in model.images.values() if image.has_pose]
    return np.stack([image.cam_from_world().rotation.matrix()[2] for image in images])


def _mean(views: ArrayF64) -> ArrayF64:  # [N, 3] -> [3]
    return np.asarray(views.sum(axis=0) / np.linalg.norm(views.sum(axis=0)))
