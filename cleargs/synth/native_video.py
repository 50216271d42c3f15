"""All frames of the video of a walk, and the true motion of the camera in each.

A capture has every fifth frame of its video. The other frames show how the camera moved around each of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pyarrow as pa
from scipy.spatial.transform import Rotation

from cleargs.parquet import column
from cleargs.synth.image_motion import SimulatedMotion
from cleargs.synth.path import FPS, HandheldPath, frame_times
from cleargs.synth.protocols import Fault
from cleargs.types import ArrayF64

NATIVE_FPS = 30.0
"""Frames per second of the video."""
STRIDE = round(NATIVE_FPS / FPS)
"""Frames of the video per frame of the capture, which is the middle one of them."""
STEP_S = 1e-4
"""Step of the central differences, seconds. For tremor of 12 Hz their error is a hundred-thousandth."""

_NUMBERS = pa.list_(pa.float64())
MOTION = pa.schema(
    [
        column("video_frame", pa.int32(), "number of the frame in capture.mp4, from 0"),
        column("image", pa.string(), "file of this frame below the capture; null: not chosen", nullable=True),
        column("time_s", pa.float64(), "middle of the middle row's exposure, seconds"),
        column("exposure_s", pa.float64(), "exposure time of a row, seconds; it may exceed 1/30 s"),
        column("readout_s", pa.float64(), "time from first to last row, seconds; 0: global shutter"),
        column("world_to_camera", _NUMBERS, "W at time_s: matrix [3, 4] with OpenCV axes, row by row"),
        column(
            "twist",
            _NUMBERS,
            "motion of the scene past the camera at time_s, in camera axes: v (world units per second), then "
            "w (radians per second). A point x moves with v + cross(w, x): dW/dt = [cross(w) v; 0 0] W",
        ),
        column("twist_rate", _NUMBERS, "derivative of the six numbers of twist at time_s, per second"),
    ]
)
"""``truth/motion.parquet``: one row per frame of the video."""


def native_frames(
    motions: Sequence[SimulatedMotion], faults: Sequence[Fault]
) -> list[tuple[SimulatedMotion, Fault]]:
    """Return motion and fault of each frame of the video, `STRIDE` per frame of the capture.

    A frame has the fault of the nearest frame of the capture. The exposure error is interpolated in time.
    """
    times = frame_times(STRIDE * len(motions), NATIVE_FPS)
    stops = np.interp(times, [motion.time for motion in motions], [fault.stops for fault in faults])
    return [
        (replace(motions[number // STRIDE], time=time), replace(faults[number // STRIDE], stops=value))
        for number, (time, value) in enumerate(zip(times.tolist(), stops.tolist(), strict=True))
    ]


def true_motion(frames: Sequence[tuple[SimulatedMotion, Fault]], images: Sequence[str]) -> pa.Table:
    """Return the table `MOTION` of ``frames``; ``images`` are the files of the chosen ones."""
    path, times = frames[0][0].path, np.array([motion.time for motion, _ in frames])
    before, speeds, after = (twists(path, times + step) for step in (-STEP_S, 0.0, STEP_S))
    rates = (after - before) / (2 * STEP_S)
    poses = path.poses(times)
    turns = poses[:, :, :3].transpose(0, 2, 1)
    chosen = {number * STRIDE + STRIDE // 2: image for number, image in enumerate(images)}
    return pa.table(
        {
            "video_frame": np.arange(len(frames)),
            "image": [chosen.get(number) for number in range(len(frames))],
            "time_s": times,
            "exposure_s": [fault.exposure for _, fault in frames],
            "readout_s": [fault.readout for _, fault in frames],
            "world_to_camera": np.concatenate([turns, -turns @ poses[:, :, 3:]], 2).reshape(-1, 12).tolist(),
            "twist": speeds.tolist(),
            "twist_rate": rates.tolist(),
        }
    )


def twists(path: HandheldPath, times: ArrayF64) -> ArrayF64:  # [T] seconds
    """Return the column ``twist`` of `MOTION` [T, 6] at ``times``."""
    before, now, after = (path.poses(times + step) for step in (-STEP_S, 0.0, STEP_S))
    turn = Rotation.from_matrix(after[:, :, :3].transpose(0, 2, 1) @ before[:, :, :3]).as_rotvec()
    shift = np.einsum("tji,tj->ti", now[:, :, :3], before[:, :, 3] - after[:, :, 3])
    return np.concatenate([shift, turn], 1) / (2 * STEP_S)
