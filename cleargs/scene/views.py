"""The frames of a capture as the views that a scene is trained on and compared with."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path

import cv2
import numpy as np

from cleargs.capture.tables import Frame, Points, load_observations
from cleargs.errors import StageError
from cleargs.splat.camera import Camera
from cleargs.splat.sparse_points import SparsePoints
from cleargs.splat.views import TrainingView
from cleargs.types import AnyImage, MaskBool, MaskU8

_RGBA = b"\x06"
"""Type of colour in the header of a PNG with alpha (byte 25)."""
GIVEN = "given"
"""Value of ``placed`` in ``ingest/frames.parquet`` for a pose that is unchanged from the input: features miss
their points by at most ``ingest.refine_above`` px (median). Ingest adjusts or estimates all other poses."""


def camera_of(frame: Frame) -> Camera:
    """Return the camera of a registered frame. Raises ValueError if it has no pose."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = frame.pose.rotation, frame.pose.translation
    return Camera(frame.width, frame.height, frame.fx, frame.fy, frame.cx, frame.cy, pose)


def view_of(frame: Frame, folder: Path, weight: float) -> TrainingView:
    """Return the view of a registered frame, whose files are in ``folder`` (the ingest folder)."""
    camera = camera_of(frame)
    image, mask = folder / frame.image, folder / frame.mask if frame.mask else None
    estimated = frame.placed not in (None, GIVEN)
    time = float(frame.frame_id) if frame.time_s is None else frame.time_s
    load, transparency = partial(_load, image, mask), partial(_alpha, image)
    movers = frame.movers or ()
    return TrainingView(frame.frame_id, camera, weight, "real", load, estimated, time, transparency, movers)


def real_views(frames: Iterable[Frame], weights: Mapping[int, float], folder: Path) -> list[TrainingView]:
    """Return views of the active frames, by frame_id: registered, not held out, weight above 0.

    No image is decoded.
    """
    active = [
        frame
        for frame in frames
        if frame.registered and frame.split == "train" and weights.get(frame.frame_id, 0.0) > 0.0
    ]
    return [
        view_of(frame, folder, weights[frame.frame_id]) for frame in sorted(active, key=lambda f: f.frame_id)
    ]


def seen_points(points: Points, ingest: Path, views: Sequence[TrainingView]) -> SparsePoints:
    """Return all ``points``, and the rows of those that each view observes, from the folder ``ingest``."""
    frame_id, point_id = load_observations(ingest)
    order = np.argsort(points.point_id)
    rows = order[np.searchsorted(points.point_id, point_id, sorter=order)]
    return SparsePoints(points.xyz, points.rgb, [rows[frame_id == view.frame_id] for view in views])


def has_alpha(image: Path) -> bool:
    """Return True if a PNG that ingest wrote has an alpha: it is a cut-out."""
    with suppress(OSError), image.open("rb") as file:
        return file.read(26)[25:] == _RGBA
    return False


def _alpha(image: Path) -> MaskU8 | None:
    """Return the alpha [H, W] of a PNG that ingest wrote; None if it has none."""
    pixels = cv2.imread(str(image), cv2.IMREAD_UNCHANGED) if has_alpha(image) else None
    return None if pixels is None else np.ascontiguousarray(pixels[..., 3])


def _load(image: Path, mask: Path | None) -> tuple[AnyImage, MaskBool | None]:
    """Decode a PNG and its mask (0 = ignore)."""
    pixels = cv2.imread(str(image), cv2.IMREAD_COLOR_RGB)
    ignored = cv2.imread(str(mask), cv2.IMREAD_GRAYSCALE) if mask is not None else None
    if pixels is None or (mask is not None and ignored is None):
        missing = image if pixels is None else mask
        raise StageError(f"cannot read {missing}", hint="run ingest again with --force ingest")
    return pixels, None if ignored is None else ignored > 0
