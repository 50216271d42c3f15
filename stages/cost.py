"""Estimates of the cost of the stages that train."""

from __future__ import annotations

from contextlib import suppress
from typing import Any

from cleargs.capture.tables import load_frames, load_points
from cleargs.errors import StoreError
from cleargs.pipeline.stage import StageContext

_UNKNOWN = (60, 0.5)  # number of frames, and megapixels per frame, that are assumed for an unknown capture
_POINTS_PER_FRAME = 250
"""Sparse points per frame that are assumed before ingest: captures of 16 to 150 frames gave 80 to 350."""
_SERIAL = 0.1  # share of the work that is not parallel (a guess)


def capture_size(context: StageContext[Any]) -> tuple[int, float]:
    """Return the number of placed training frames and megapixels of the largest; estimates before ingest."""
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
    """Return the number of sparse points. Estimate it before ingest, and if the points cannot be read."""
    if "ingest" in context.inputs:
        with suppress(StoreError):
            return len(load_points(context.inputs["ingest"]).point_id)
    return _POINTS_PER_FRAME * capture_size(context)[0]


def pace(threads: int) -> float:
    """Return the time on ``threads`` threads relative to the measurements on two threads (Amdahl's law)."""
    return (_SERIAL + (1.0 - _SERIAL) / threads) / (_SERIAL + (1.0 - _SERIAL) / 2)
