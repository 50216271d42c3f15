"""A scene turned for a program that has an up axis of its own, its first view before the default camera."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from cleargs.splat.camera import Camera

UP: Mapping[str, tuple[tuple[float, ...], ...]] = {
    "-y": ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    "y": ((1, 0, 0), (0, -1, 0), (0, 0, -1)),
    "z": ((1, 0, 0), (0, 0, 1), (0, -1, 0)),
}
"""Up axis -> the matrix from x right, y down, z forward. Programs with y up look along -z, and with z up
along y, before anyone moves their camera."""


def upright(first: Camera, up: str) -> dict[str, Any]:
    """Scale, rotation [3, 3] and translation [3] from the normalised world to one with ``up`` of `UP`, in
    which ``first`` stands at the origin and looks ahead. Up stays up, whatever its pitch and roll."""
    ahead = first.world_to_camera[2, :3] * [1.0, 0.0, 1.0]
    length = float(np.linalg.norm(ahead))
    x, _, z = ahead / length if length > 1e-6 else (0.0, 0.0, 1.0)  # straight up or down: as it lies
    rotation = np.array(UP[up]) @ [[z, 0.0, -x], [0.0, 1.0, 0.0], [x, 0.0, z]]
    return {"scale": 1.0, "rotation": rotation, "translation": -rotation @ first.centre}
