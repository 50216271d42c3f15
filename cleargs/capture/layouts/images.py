"""A folder of images and nothing else."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from cleargs.capture.capture import Capture, External, SourceFrame
from cleargs.capture.config import CaptureConfig
from cleargs.capture.folders import chosen, frame_key, image_files, image_folders, mask_externals
from cleargs.errors import InputError


def detect(source: Path, *, poses: bool) -> bool:
    """See `Layout.detect`: any folder."""
    return True


def externals(source: Path, config: CaptureConfig) -> Mapping[str, External]:
    """See `Layout.externals`."""
    images = _images_of(source)
    return {"capture" if images == source else "images": images, **mask_externals(source)}


def open_capture(source: Path, config: CaptureConfig) -> Capture:
    """See `Layout.open_capture`; in the order of `frame_key`."""
    files = sorted(image_files(_images_of(source)), key=lambda path: frame_key(path.name))
    if not files:
        raise InputError(
            f"{source} holds no images, no video and no transforms.json",
            hint="give a video, a folder of images, a COLMAP project, or a folder with transforms.json",
        )
    frames = [SourceFrame(path.name, path) for path in files]
    return Capture("images", chosen(frames, source, config.max_frames), len(frames))


def _images_of(root: Path) -> Path:
    """The first folder that holds any image of ``images/``, ``root`` itself, and the reductions, the largest
    first; ``root`` where none does.
    """
    folders = [root / "images", root, *image_folders(root)]
    return next((folder for folder in folders if folder.is_dir() and image_files(folder)), root)
