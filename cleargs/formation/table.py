"""``formation.parquet``: the image formation of each frame, as a training estimated it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import pyarrow as pa

from cleargs.formation.capture import CaptureFormation
from cleargs.formation.frame import AXES, FrameFormation, as_row, from_row
from cleargs.formation.motion import TWISTS
from cleargs.parquet import column, read_table, write_table

_TWISTS = {
    "pose": " from the pose as given to the mean pose of the exposure",
    "blur": " from the start to the end of a row's exposure, linear in time",
    "skew": " from the first to the last row's exposure",
    "skew_bend": ", times s^2 at s of the readout, -1/2 to 1/2",
    "bend": ", times t^2 - 1/12 at time t of the exposure, -1/2 to 1/2",
    "cube": ", times t^3 - 3t/20 at time t of the exposure, -1/2 to 1/2",
}


def _component(name: str, axis: str) -> pa.Field:
    text = f"{axis} of the scene past the camera{_TWISTS[name]}, px: t times fx / median depth, r times fx"
    return column(f"{name}_{axis}", pa.float64(), text)


FORMATION = pa.schema(
    [
        column("frame_id", pa.int32(), "active frame"),
        column("steps", pa.int64(), "steps since the first estimate of the formation"),
        column("model", pa.string(), "none, blur, skew, both (blur and skew) or defocus"),
        column("order", pa.int32(), "order of the path: 1 straight, 2 quadratic, 3 cubic"),
        column("blur_px", pa.float64(), "mean length of the pixels' paths during the exposure, px"),
        column(
            "skew_px", pa.float64(), "mean length of the paths from the first row's time to the last's, px"
        ),
        column("defocus_px", pa.float64(), "mean radius of the discs of defocus, px"),
        column("displacement_px", pa.float64(), "distance from a pixel to what it shows: 95 % quantile, px"),
        column("explained", pa.float64(), "share of the frame's residual that the model removes"),
        column("residual", pa.float64(), "mean difference of high-passed linear luminance with the model"),
        column("residual_without", pa.float64(), "the same difference without the model"),
        column(
            "skew_gain",
            pa.float64(),
            "share of the residual that a rolling shutter explains beyond blur and defocus",
            nullable=True,
        ),
        column(
            "blur_gain",
            pa.float64(),
            "least share of the squared error that further blur explained since the last search",
        ),
        column("weight_before", pa.float64(), "RVA's weight of the frame"),
        column("weight_after", pa.float64(), "weight of the frame at the end of the training"),
        *(_component(name, axis) for name in TWISTS for axis in AXES),
        column(
            "disc_px", pa.float64(), "radius of the disc of defocus per unit of nearness beyond the focus, px"
        ),
        column("focus", pa.float64(), "nearness in focus: median depth over the depth in focus"),
        column("median_depth", pa.float64(), "median depth of the frame, world units"),
        column(
            "exposure_s",
            pa.float64(),
            "exposure time, s, of a blur that is the measured motion during it; 0: the blur was searched",
        ),
        column("columns", pa.bool_(), "true if the columns are read one after the other, not the rows"),
    ]
)


def write_formation(path: Path, formation: CaptureFormation, weights: Mapping[int, float]) -> None:
    """Write ``formation.parquet``. ``weights`` are RVA's weights of the frames, by frame_id."""
    rows = [
        as_row(frame)
        | {
            "explained": frame.explained,
            "weight_before": weights[frame_id],
            "weight_after": formation.weight(frame_id),
        }
        for frame_id, frame in formation.frames.items()
    ]
    write_table(path, pa.Table.from_pylist(rows, FORMATION), FORMATION)


def read_formation(path: Path) -> tuple[dict[int, FrameFormation], dict[int, float]]:
    """Read ``formation.parquet``: the formations, and the weights at the end, by frame_id.

    Raises StoreError if it is missing or damaged.
    """
    rows = read_table(path, FORMATION).to_pylist()
    weights = {row["frame_id"]: row["weight_after"] for row in rows}
    return {row["frame_id"]: from_row(row) for row in rows}, weights
