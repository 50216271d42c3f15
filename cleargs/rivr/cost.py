"""What RIVR and the consolidation are expected to take."""

from __future__ import annotations

from pathlib import Path

from cleargs.capture.tables import load_frames
from cleargs.errors import StoreError

_UNKNOWN = (60, 0.5)
"""Frames and megapixels assumed before the capture is prepared."""


def capture_size(ingest: Path | None) -> tuple[int, float]:
    """Registered training frames of a prepared capture, and the megapixels of one."""
    if ingest is None:
        return _UNKNOWN
    try:
        frames = [f for f in load_frames(ingest) if f.registered and f.split == "train"]
    except StoreError:
        return _UNKNOWN
    return len(frames), max((f.width * f.height for f in frames), default=0) / 1e6
