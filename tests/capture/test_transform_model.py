"""A moved COLMAP model, read by COLMAP."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from cleargs.capture.cameras import Pose, pinhole
from cleargs.capture.colmap import pycolmap
from cleargs.capture.model import ModelImage, SparseModel, transform_model, write_model


def test_every_point_keeps_its_place_in_every_image(tmp_path: Path) -> None:
    chance = np.random.default_rng(0)
    xyz, ids = chance.normal(size=(9, 3)), np.arange(9, dtype=np.int64)
    turned = Rotation.from_rotvec([0.1, 0.2, -0.1]).as_matrix()
    images = {}
    for key, x in ((1, -0.5), (2, 0.5)):
        pose = Pose(turned, np.array([x, 0.1, 5.0]))
        local = xyz @ pose.rotation.T + pose.translation
        images[key] = ModelImage(
            f"{key}.png", 1, pose, local[:, :2] / local[:, 2:] * 100.0 + [32.0, 24.0], ids
        )
    model = SparseModel({1: pinhole(64, 48, 100.0, 100.0, 32.0, 24.0)}, images, ids, xyz, np.zeros(9))
    turn, shift = Rotation.from_rotvec([1.0, -0.4, 2.0]).as_matrix(), np.array([4.0, 5.0, -6.0])
    write_model(
        tmp_path,
        transform_model(model, scale=2.5, rotation=turn, translation=shift),
        np.full((9, 3), 7, np.uint8),
    )
    found = pycolmap.Reconstruction(str(tmp_path))
    assert found.num_reg_images() == 2 and found.num_points3D() == 9
    for key, image in images.items():
        seen = found.image(key)
        assert np.allclose(seen.projection_center(), 2.5 * turn @ image.pose.centre + shift)
        for point_id in range(9):
            where = found.point3D(point_id).xyz
            assert np.allclose(where, 2.5 * turn @ xyz[point_id] + shift)
            assert np.allclose(seen.project_point(where), image.xy[point_id], atol=1e-6)
