"""A folder of images without poses."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from cleargs.capture.capture import Capture, External, SourceFrame
from cleargs.capture.config import CaptureConfig
from cleargs.capture.contents import contents_of
from cleargs.capture.folders import chosen, image_files, mask_externals
from cleargs.errors import InputError


def detect(source: Path, config: CaptureConfig) -> bool:
    """See `Layout.detect`: any folder."""
    return True


def externals(source: Path, config: CaptureConfig) -> Mapping[str, External]:
    contents = contents_of(source, config)
    folder = contents.folder
    role = "capture" if folder == source else "images"
    found: dict[str, External] = {role: folder}
    if len(contents.photographs) != len(image_files(folder)):
        found[role] = {path.relative_to(folder).as_posix(): path for path in contents.photographs}
    if contents.masks:
        found["masks_beside"] = {m.relative_to(source).as_posix(): m for m in contents.masks.values()}
    return {**found, **mask_externals(source)}


def open_capture(source: Path, config: CaptureConfig) -> Capture:
    """See `Layout.open_capture`. The frames are in the order of `frame_key`."""
    contents = contents_of(source, config)
    folder, masks = contents.folder, contents.masks
    if not contents.photographs:
        raise InputError(
            f"{source} holds no images, no video and no transforms.json",
            hint="give a video, a folder of images, a COLMAP project, or a folder with transforms.json",
        )
    frames = [
        SourceFrame(path.relative_to(folder).as_posix(), path, mask=masks.get(path))
        for path in contents.photographs
    ]
    taken = chosen(frames, source, config.max_frames)
    return Capture("images", taken, len(frames), told=contents.told(), notes=contents.warnings())
