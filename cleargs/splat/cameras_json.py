"""``cameras.json`` in the layout of the Inria code, which viewers import beside a PLY."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cleargs.splat.camera import Camera


def cameras_json(
    cameras: Sequence[tuple[str, Camera]],
    *,
    scale: float = 1.0,
    rotation: NDArray[np.float64] | None = None,  # [3, 3]
    translation: NDArray[np.float64] | None = None,  # [3]
) -> list[dict[str, Any]]:
    """One entry a named camera, moved by x -> scale rotation x + translation: its centre, camera to world."""
    turn = np.eye(3) if rotation is None else rotation
    shift = np.zeros(3) if translation is None else translation
    return [
        {
            "id": index,
            "img_name": name,
            "width": camera.width,
            "height": camera.height,
            "position": (scale * turn @ camera.centre + shift).tolist(),
            "rotation": (turn @ camera.world_to_camera[:3, :3].T).tolist(),
            "fy": camera.fy,
            "fx": camera.fx,
        }
        for index, (name, camera) in enumerate(cameras)
    ]
