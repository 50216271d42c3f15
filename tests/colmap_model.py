"""Sparse models and formation tables for hand-made runs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow as pa

from cleargs.capture.cameras import Pose, pinhole
from cleargs.capture.model import ModelImage, SparseModel, write_model
from cleargs.capture.tables import POINTS, load_frames
from cleargs.formation.movement import write_movement
from cleargs.formation.table import FORMATION
from cleargs.parquet import write_table

POINTS_XYZ = np.random.default_rng(0).uniform([-0.5, -0.3, 1.8], [0.5, 0.3, 2.2], (12, 3))


def write_sparse(ingest: Path) -> None:
    """Write twelve points, which all placed frames see, as COLMAP model and as table."""
    ids = np.arange(len(POINTS_XYZ), dtype=np.int64)
    cameras, images = {}, {}
    for frame in load_frames(ingest):
        if not frame.registered:
            continue
        key = frame.frame_id + 1
        camera = pinhole(frame.width, frame.height, frame.fx, frame.fy, frame.cx, frame.cy)
        pose = Pose.from_quaternion(
            np.array([frame.qw, frame.qx, frame.qy, frame.qz]), np.array([frame.tx, frame.ty, frame.tz])
        )
        local = POINTS_XYZ @ pose.rotation.T + pose.translation
        xy = local[:, :2] / local[:, 2:] * camera.focal + camera.centre
        cameras[key], images[key] = camera, ModelImage(Path(frame.image).name, key, pose, xy, ids)
    rgb = np.full((len(ids), 3), 128, np.uint8)
    error = np.zeros(len(ids))
    write_model(ingest / "colmap/sparse/0", SparseModel(cameras, images, ids, POINTS_XYZ, error), rgb)
    columns = {
        "point_id": ids,
        **{name: POINTS_XYZ[:, axis] for axis, name in enumerate("xyz")},
        **dict.fromkeys("rgb", rgb[:, 0]),
        "error": error,
        "track_length": np.full(len(ids), len(images), np.int32),
    }
    write_table(ingest / "points.parquet", pa.table(columns, POINTS), POINTS)


def write_no_formation(stage: Path) -> None:
    """Write the tables of a training that found no motion and no movement."""
    write_table(stage / "formation.parquet", pa.Table.from_pylist([], FORMATION), FORMATION)
    write_movement(stage / "movement.parquet", {})
