"""What the stages that train are expected to take."""

from __future__ import annotations

from contextlib import suppress
from typing import Any

from cleargs.capture.tables import load_frames, load_points
from cleargs.errors import StoreError
from cleargs.pipeline.stage import StageContext

_UNKNOWN = (60, 0.5)
"""Frames and megapixels assumed where nothing is known of the capture."""
_POINTS_PER_FRAME = 250
"""Sparse points assumed before ingest: captures of 16 to 150 frames gave 80 to 350."""
_SERIAL = 0.1
"""Share of the work that more threads do not speed up (a guess)."""


def capture_size(context: StageContext[Any]) -> tuple[int, float]:
    """Registered training frames of a capture, and the megapixels of one; before ingest, what it expects."""
    if (expected := context.expected.get("ingest")) is not None and expected.frames:
        return expected.frames, expected.megapixels
    if "ingest" not in context.inputs:
        return _UNKNOWN
    try:
        frames = [f for f in load_frames(context.inputs["ingest"]) if f.registered and f.split == "train"]
    except StoreError:
        return _UNKNOWN
    return len(frames), max((f.width * f.height for f in frames), default=0) / 1e6


def sparse_points(context: StageContext[Any]) -> int:
    """Sparse points of a capture; before ingest, and where they cannot be read, as its frames let expect."""
    if "ingest" in context.inputs:
        with suppress(StoreError):
            return len(load_points(context.inputs["ingest"]).point_id)
    return _POINTS_PER_FRAME * capture_size(context)[0]


def pace(threads: int) -> float:
    """Time on so many threads over that on two, on which the stages were measured."""
    return (_SERIAL + (1.0 - _SERIAL) / threads) / (_SERIAL + (1.0 - _SERIAL) / 2)
