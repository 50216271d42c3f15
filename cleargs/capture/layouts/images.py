"""A folder of images without poses."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from cleargs.capture.capture import Capture, External
from cleargs.capture.config import CaptureConfig
from cleargs.capture.contents import LISTS, contents_of
from cleargs.capture.folders import chosen
from cleargs.capture.other_files import remedy_in
from cleargs.errors import InputError


def detect(source: Path, config: CaptureConfig) -> bool:
    """See `Layout.detect`: any folder."""
    return True


def externals(source: Path, config: CaptureConfig) -> Mapping[str, External]:
    return contents_of(source, config).externals()


def open_capture(source: Path, config: CaptureConfig) -> Capture:
    """See `Layout.open_capture`. The frames are in the order of `frame_key`."""
    contents = contents_of(source, config)
    frames = contents.frames()
    if not frames:
        raise InputError(
            f"{source} holds no images, no video and no transforms.json",
            hint=remedy_in(source, "give a video, a folder of images, a COLMAP project or transforms.json"),
        )
    patterns = [*(f"*/{name}" for name in LISTS), "dense/*/sparse"] if config.uses_poses else []
    nested = [path for pattern in patterns for path in sorted(source.glob(pattern))]
    notes = [f"poses in {path} are not read: give {path.parent} as the input" for path in nested[:1]]
    return Capture(
        "images",
        chosen(frames, source, config.max_frames),
        len(frames),
        available=tuple(frames),
        told=contents.told(),
        notes=(*contents.warnings(), *notes),
    )
