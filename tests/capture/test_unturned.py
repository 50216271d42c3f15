"""Cameras that all look the same way leave their focal length open."""

from __future__ import annotations

import numpy as np
import pytest

from cleargs.capture.colmap import pycolmap
from cleargs.capture.unturned import TURNED, refocused, turned

FOCAL = 200.0


def flight(rolls: bool) -> pycolmap.Reconstruction:
    """Return eight cameras that look along z, almost in one plane, with exact keypoints."""
    random, model = np.random.default_rng(0), pycolmap.Reconstruction()
    camera = pycolmap.Camera(
        model="SIMPLE_RADIAL", width=240, height=180, params=[FOCAL, 120, 90, 0.01], camera_id=1
    )
    model.add_camera_with_trivial_rig(camera)
    points = random.uniform((-1.5, -1.0, 2.0), (1.5, 1.0, 3.5), (150, 3))
    tracks = [pycolmap.Track() for _ in points]
    for key in range(1, 9):
        angle = np.pi * (key % 2) if rolls else 0.0
        turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1.0]])
        centre = random.uniform((-0.5, -0.5, -0.1), (0.5, 0.5, 0.1))
        image = pycolmap.Image(name=f"{key}.png", camera_id=1, image_id=key)
        image.points2D = [
            pycolmap.Point2D(xy) for xy in np.asarray(camera.img_from_cam((points - centre) @ turn.T))
        ]
        pose = pycolmap.Rigid3d(np.column_stack([turn, -turn @ centre]))
        model.add_image_with_trivial_frame(image, pose)
        for number, track in enumerate(tracks):
            track.add_element(key, number)
    for xyz, track in zip(points, tracks, strict=True):
        model.add_point3D(xyz, track)
    return model


@pytest.mark.parametrize("rolls", [False, True])
def test_any_focal_length_gives_the_same_pictures(rolls: bool) -> None:
    right = flight(rolls)
    assert turned(right) < TURNED
    wrong = refocused(right, 3 * FOCAL)
    assert wrong.cameras[1].params[0] == 3 * FOCAL
    assert wrong.compute_mean_reprojection_error() < 0.05
    again = refocused(wrong, FOCAL)
    assert again.compute_mean_reprojection_error() < 0.05
    similarity = pycolmap.estimate_sim3d(
        np.array([again.points3D[key].xyz for key in sorted(again.points3D)]),
        np.array([right.points3D[key].xyz for key in sorted(right.points3D)]),
    )
    moved = np.array([similarity * again.points3D[key].xyz for key in sorted(again.points3D)])
    true = np.array([right.points3D[key].xyz for key in sorted(right.points3D)])
    assert np.linalg.norm(moved - true, axis=1).max() < 0.02


def test_a_walk_around_a_subject_turns() -> None:
    options = pycolmap.SyntheticDatasetOptions(num_rigs=1, num_cameras_per_rig=1, num_frames_per_rig=8)
    assert turned(pycolmap.synthesize_dataset(options)) > 10 * TURNED
