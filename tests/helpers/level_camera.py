"""The camera of the reports' viewer where the page does not turn it."""

from __future__ import annotations

import numpy as np

from cleargs.splat.camera import Camera, look_at


def level_camera(camera: Camera, width: int, height: int) -> Camera:
    """Return ``camera`` without roll, with a centred axis, for a canvas of ``width`` x ``height`` px."""
    target = camera.centre + camera.world_to_camera[2, :3]
    pose = look_at(camera.centre, target, np.array([0.0, -1.0, 0.0]))
    side, focal = (camera.width, camera.fx) if camera.width > camera.height else (camera.height, camera.fy)
    focal *= max(width, height) / side
    return Camera(width, height, focal, focal, width / 2, height / 2, pose)
