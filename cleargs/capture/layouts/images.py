"""A folder of images without poses."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from cleargs.capture.capture import Capture, External, SourceFrame
from cleargs.capture.config import CaptureConfig
from cleargs.capture.folders import (
    chosen,
    folder_of_images,
    folders_to_search,
    frame_key,
    image_files,
    left_out,
    mask_externals,
)
from cleargs.errors import InputError


def detect(source: Path, *, poses: bool) -> bool:
    """See `Layout.detect`: any folder."""
    return True


def externals(source: Path, config: CaptureConfig) -> Mapping[str, External]:
    images = _images_of(source)
    return {"capture" if images == source else "images": images, **mask_externals(source)}


def open_capture(source: Path, config: CaptureConfig) -> Capture:
    """See `Layout.open_capture`. The frames are in the order of `frame_key`."""
    folder = _images_of(source)
    files = sorted(image_files(folder), key=lambda path: frame_key(path.name))
    if not files:
        raise InputError(
            f"{source} holds no images, no video and no transforms.json",
            hint="give a video, a folder of images, a COLMAP project, or a folder with transforms.json",
        )
    frames = [SourceFrame(path.name, path) for path in files]
    notes = left_out(folder)
    taken = chosen(frames, source, config.max_frames)
    return Capture("images", taken, len(frames), available=tuple(frames), notes=notes)


def _images_of(root: Path) -> Path:
    """Return the folder with the images. It may have any name if the usual folders have no images."""
    if (folder := folder_of_images(root)) is not None:
        return folder
    others = [folder for folder in folders_to_search(root) if image_files(folder)] if root.is_dir() else []
    return max(others, key=lambda folder: len(image_files(folder)), default=root)
