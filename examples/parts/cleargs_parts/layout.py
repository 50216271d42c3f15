"""An input layout: ingest.layout=listed reads the images that list.txt in the input names, one per line."""

from collections.abc import Mapping
from pathlib import Path

from cleargs.capture.capture import Capture, External, SourceFrame
from cleargs.capture.config import CaptureConfig
from cleargs.capture.folders import spread
from cleargs.errors import InputError


def externals(source: Path, config: CaptureConfig) -> Mapping[str, External]:
    """Return all files that are read; the key of the stage depends on their content."""
    return {"list": source / "list.txt", "images": {name: source / name for name in _names(source)}}


def open_capture(source: Path, config: CaptureConfig) -> Capture:
    """Return frames without cameras and poses, which SfM then estimates; a SourceFrame may have both."""
    names = _names(source)
    frames = tuple(SourceFrame(name, source / name) for name in spread(names, config.max_frames))
    return Capture("listed", frames, len(names))


def _names(source: Path) -> list[str]:
    try:
        return (source / "list.txt").read_text(encoding="utf-8").split()
    except OSError as error:
        raise InputError(f"{source} has no list.txt", hint="write the names of the images into it") from error
