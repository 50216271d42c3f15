"""Motions that ingest measured in the video (``ingest/motion.parquet``), as image formation uses them."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from cleargs.capture.motion_table import MOTION
from cleargs.formation.motion import TWIST, FrameMotion
from cleargs.formation.search import Measurement
from cleargs.parquet import read_table
from cleargs.splat.camera import Camera
from cleargs.types import ArrayF64


@dataclass(frozen=True, eq=False)
class MeasuredPath:
    """Path of the camera around the time of one frame, and the readout time of its shutter."""

    path: ArrayF64  # [4, 6] derivatives by the time of the motion of the scene past the camera
    covariance: ArrayF64  # [6, 6] of the speed
    frame_s: float
    """Time to the nearest frame of the video, s."""
    depth: float
    """Median depth of the sparse points in the frame."""
    readout_s: float = 0.0
    """Time from the first row's exposure to the last one's, s; 0: the shutter does not roll."""
    columns: bool = False
    """True if the columns are read one after the other."""

    @property
    def rolls(self) -> bool:
        """True if the shutter rolls."""
        return self.readout_s != 0.0

    def read(self, camera: Camera, depth: float | None = None) -> FrameMotion:
        """Return the motion during the readout alone, px of ``camera``. ``depth`` is the median depth."""
        scales = self._scales(camera, depth)
        return FrameMotion(
            skew=self.readout_s * self.path[0] * scales,
            skew_bend=0.5 * self.readout_s**2 * self.path[1] * scales,
            columns=self.columns,
            median_depth=depth or self.depth,
        )

    def exposed(self, seconds: float, camera: Camera, depth: float | None = None) -> FrameMotion:
        """Return the motion during the readout and an exposure of ``seconds``, px of ``camera``."""
        speed, change, third = (
            row * self._scales(camera, depth) * seconds**order / math.factorial(order)
            for order, row in enumerate(self.path[:3], start=1)
        )
        # t, t^2 and t^3 in the orthogonal polynomials of `FrameMotion`.
        return replace(
            self.read(camera, depth),
            pose=change / 12,
            blur=speed + 0.15 * third,
            bend=change,
            cube=third,
            exposure_s=seconds,
        )

    def measurement(self, seconds: float, camera: Camera, depth: float) -> Measurement:
        """Return the speed in px per frame of the video, for an exposure of ``seconds``."""
        scales = self.frame_s * self._scales(camera, depth)
        covariance = self.covariance * np.outer(scales, scales)
        precision = np.linalg.inv(covariance + 1e-6 * np.trace(covariance) / TWIST * np.eye(TWIST))
        exposure, readout = seconds / self.frame_s, self.readout_s / self.frame_s
        return Measurement(self.path[0] * scales, precision, exposure, readout)

    def _scales(self, camera: Camera, depth: float | None) -> ArrayF64:  # [6]
        """Return px per world unit and per radian."""
        return camera.fx * np.array([1.0 / (depth or self.depth)] * 3 + [1.0] * 3)


def load_paths(ingest: Path) -> dict[int, MeasuredPath]:
    """Return the measured paths of the frames in the folder ``ingest``, by frame_id.

    A folder of an older version has none. Raises StoreError if the table is damaged.
    """
    table = ingest / "motion.parquet"
    if not table.is_file():
        return {}
    return {
        row["frame_id"]: MeasuredPath(
            np.array(row["path"]).reshape(-1, TWIST),
            np.array(row["covariance"]).reshape(TWIST, TWIST),
            row["frame_s"],
            row["median_depth"],
            row["readout_s"] or 0.0,
            row["readout_columns"],
        )
        for row in read_table(table, MOTION).to_pylist()
        if row["path"] is not None
    }
