"""The tables of ``ingest``: what every later stage knows of the capture.

World: normalised (origin at the mean camera centre, farthest camera at distance 1, mean camera up along -y).
Poses are COLMAP's: world to camera, OpenCV axes (x right, y down, z forward), unit quaternions w x y z, pixel
centres at + 0.5.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from cleargs.digest import is_inside
from cleargs.errors import StoreError
from cleargs.parquet import column, read_table, schema_of

if TYPE_CHECKING:
    from cleargs.capture.cameras import Pose

_POSE = "world to camera (COLMAP, OpenCV axes); null when unregistered"
_Size = Annotated[int, "of the undistorted image, px"]
_Focal = Annotated[float, "focal length, px"]
_Centre = Annotated[float, "principal point, px; the centre of the first pixel is 0.5"]
_Rotation = Annotated[float | None, f"rotation, {_POSE}"]
_Translation = Annotated[float | None, f"translation, {_POSE}"]


@dataclass(frozen=True)
class Frame:
    """One frame of a prepared capture. Images are pinhole: undistorted, resized, PNG."""

    frame_id: Annotated[int, "position in the capture, from 0, without gaps"]
    name: Annotated[str, "name in the input: file path, or video name and frame number"]
    image: Annotated[str, "undistorted PNG, relative to this folder"]
    time_s: Annotated[float | None, "presentation time, s; null without a clock"]
    width: _Size
    height: _Size
    fx: _Focal
    fy: _Focal
    cx: _Centre
    cy: _Centre
    qw: _Rotation
    qx: _Rotation
    qy: _Rotation
    qz: _Rotation
    tx: _Translation
    ty: _Translation
    tz: _Translation
    registered: Annotated[bool, "true if the frame has a pose"]
    n_points: Annotated[int, "sparse points that the frame observes"]
    split: Annotated[Literal["train", "test"], "train, or test (held out: has a pose, enters nothing else)"]
    placed: Annotated[str | None, "method by which the pose was found, or the reason why there is none"]
    mask: str | None
    """Path relative to the ingest folder, ``masks/000012.png`` (0 = ignore), or None. Not in the table."""
    kept_out_keypoints: Annotated[
        int | None, "keypoints of tracks that took no part in the fit of the cameras"
    ] = None
    kept_out_share: Annotated[float | None, "share of these within 2 px of their places by the cameras"] = (
        None
    )
    kept_out_px: Annotated[
        float | None, "median distance of these from their places, px of the working image"
    ] = None

    movers: tuple[tuple[int, int, int, int], ...] | None = None
    """Boxes of what may move (left, top, right, bottom, px), of `MOVERS`; None: it was not looked for."""

    @property
    def pose(self) -> Pose:
        """Pose in the normalised world. Raises ValueError if the frame has none."""
        from cleargs.capture.cameras import (
            Pose,  # it needs SciPy, which commands that only read tables do not load
        )

        numbers = self.qw, self.qx, self.qy, self.qz, self.tx, self.ty, self.tz
        known = np.array([number for number in numbers if number is not None], np.float64)
        if not self.registered or len(known) < len(numbers) or np.isnan(known).any():
            raise ValueError(f"frame {self.frame_id} has no pose")
        return Pose.from_quaternion(known[:4], known[4:])


FRAMES = schema_of(Frame)

POINTS = pa.schema(
    [
        column("point_id", pa.int64(), "unique in this table"),
        *(column(axis, pa.float64(), "position in the normalised world") for axis in "xyz"),
        *(column(x, pa.uint8(), "sRGB, mean over the train frames that observe the point") for x in "rgb"),
        column("error", pa.float64(), "mean reprojection error, px of the image in which features are found"),
        column("track_length", pa.int32(), "registered frames that observe the point; 0: a laser scanner's"),
    ]
)

OBSERVATIONS = pa.schema(
    [
        column("frame_id", pa.int32(), "registered frame i"),
        column("point_id", pa.int64(), "sparse point that it observes (the paper's P_i), once a pair"),
    ]
)


MOVERS = pa.schema(
    [
        column("frame_id", pa.int32(), "frame that shows a person, an animal, a vehicle or a screen"),
        *(column(side, pa.int32(), "side of its box, px") for side in ("left", "top", "right", "bottom")),
    ]
)
"""``movers.parquet``, if the model ``people`` is installed: see `cleargs.capture.movers`."""


@dataclass(frozen=True)
class Points:
    """The sparse points, by point_id."""

    point_id: NDArray[np.int64]  # [P]
    xyz: NDArray[np.float64]  # [P, 3]
    rgb: NDArray[np.uint8]  # [P, 3] sRGB
    error: NDArray[np.float64]  # [P] px
    track_length: NDArray[np.int32]  # [P], 0: a point of the input that no image observes

    @property
    def observed_rgb(self) -> NDArray[np.uint8]:  # [S, 3]
        """Colours of the points in the COLMAP model of ingest: those that frames observe."""
        return self.rgb[self.track_length > 0]


def load_frames(ingest_dir: Path) -> list[Frame]:
    """Return all frames of a finished ingest folder by frame_id, unregistered ones too. Raises StoreError."""
    table = read_table(ingest_dir / "frames.parquet", FRAMES)
    frames, movers = [], _load_movers(ingest_dir / "movers.parquet")
    for row in table.to_pylist():
        if not is_inside(row["image"]):
            raise StoreError(f"{ingest_dir} names an image outside", hint="do not use this run")
        mask = f"masks/{Path(row['image']).stem}.png"
        frames.append(
            Frame(
                **row,
                mask=mask if (ingest_dir / mask).is_file() else None,
                movers=None if movers is None else tuple(movers.get(row["frame_id"], ())),
            )
        )
    return sorted(frames, key=lambda frame: frame.frame_id)


def _load_movers(path: Path) -> dict[int, list[tuple[int, int, int, int]]] | None:
    """Return the boxes of what may move, by frame_id; None if it was not looked for."""
    if not path.is_file():
        return None
    movers: dict[int, list[tuple[int, int, int, int]]] = {}
    for row in read_table(path, MOVERS).to_pylist():
        box = row["left"], row["top"], row["right"], row["bottom"]
        movers.setdefault(row["frame_id"], []).append(box)
    return movers


def load_points(ingest_dir: Path) -> Points:
    """Return the sparse points of a finished ingest folder. Raises StoreError."""
    table = read_table(ingest_dir / "points.parquet", POINTS)
    get = {name: table.column(name).to_numpy() for name in POINTS.names}
    xyz, rgb = (np.stack([get[name] for name in names], axis=1) for names in ("xyz", "rgb"))
    return Points(get["point_id"], xyz, rgb, get["error"], get["track_length"])


def load_observations(ingest_dir: Path) -> tuple[NDArray[np.int32], NDArray[np.int64]]:
    """Return the pairs frame_id [M], point_id [M] of a finished ingest folder (P_i). Raises StoreError."""
    table = read_table(ingest_dir / "observations.parquet", OBSERVATIONS)
    return table.column("frame_id").to_numpy(), table.column("point_id").to_numpy()
