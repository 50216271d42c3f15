"""Scenes for programs with another up axis."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cleargs.splat.camera import Camera
from cleargs.splat.transforms import UP, orient_up

AHEAD = {"-y": [0, 0, 1], "y": [0, 0, -1], "z": [0, 1, 0]}
"""Initial view direction of programs with this up axis: COLMAP's viewers, three.js, Blender."""
AXES = {"-y": [0, -1, 0], "y": [0, 1, 0], "z": [0, 0, 1]}


def camera(turn: Rotation) -> Camera:
    """Return a camera at (1, 2, 3), rotated from looking along +z with y down."""
    pose = np.eye(4)
    pose[:3, :3] = turn.as_matrix().T
    pose[:3, 3] = -pose[:3, :3] @ [1.0, 2.0, 3.0]
    return Camera(64, 48, 50.0, 50.0, 32.0, 24.0, pose)


@pytest.mark.parametrize("up", list(UP))
@pytest.mark.parametrize("pitch", [0.0, 0.6])
def test_the_first_camera_looks_ahead_from_the_origin(up: str, pitch: float) -> None:
    first = camera(Rotation.from_euler("YXZ", [2.1, pitch, 0.0 if pitch == 0.0 else 0.3]))
    move = orient_up(first, up)
    turn = move["rotation"]
    assert np.allclose(turn @ turn.T, np.eye(3)) and np.linalg.det(turn) == pytest.approx(1.0)
    assert np.allclose(turn @ [0, -1, 0], AXES[up])  # pitch and roll of the camera do not affect the up axis
    assert np.allclose(turn @ first.centre + move["translation"], 0.0) and move["scale"] == 1.0
    forward = turn @ first.world_to_camera[2, :3]
    assert forward @ AHEAD[up] == pytest.approx(np.cos(pitch)) and abs(forward[0]) < 1e-9


def test_a_camera_that_looks_down_keeps_its_heading() -> None:
    assert np.allclose(orient_up(camera(Rotation.from_euler("x", -np.pi / 2)), "-y")["rotation"], np.eye(3))
