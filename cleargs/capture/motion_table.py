"""The table of the measured motions (``ingest/motion.parquet``)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import pyarrow as pa

from cleargs.parquet import schema_of

_PER_S = "per s (per frame if the capture has no clock)"
_TWIST = "of the scene past the camera in camera axes: tx, ty, tz in world units, rx, ry, rz in radians"
_NUMBERS = pa.list_(pa.float64())


@dataclass(frozen=True)
class MotionRow:
    """Row of ``motion.parquet``: the motion of the camera at a frame."""

    frame_id: Annotated[int, "frame of frames.parquet"]
    status: Annotated[str, "measured, or the reason why there is no motion"]
    tracks: Annotated[int | None, "tracks into the neighbour with the fewest"]
    error_px: Annotated[float | None, "median distance of the tracks from the path, px of the working image"]
    median_depth: Annotated[float | None, "median depth of the tracked points, world units"]
    speed_px: Annotated[float | None, f"mean speed of the tracked points, px of the working image {_PER_S}"]
    doubt: Annotated[float | None, "share of the speed that the farther neighbours change"]
    path: Annotated[
        list[float] | None, _NUMBERS, f"speed, then its first three derivatives, {_PER_S}; each {_TWIST}"
    ]
    covariance: Annotated[list[float] | None, _NUMBERS, "covariance of the speed, 6x6 by rows"]
    frame_s: Annotated[float | None, "time to the nearest neighbour, s (1 frame if there is no clock)"]
    readout_s: Annotated[
        float | None,
        "time from the first row's exposure to the last one's, s or frames; null: none was found",
    ]
    readout_columns: Annotated[bool, "true if the columns are read one after the other, not the rows"]


MOTION = schema_of(MotionRow)
