"""From an input to a capture: the first layout that knows the input reads it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from cleargs.capture.capture import Capture, External, Layout
from cleargs.capture.config import CaptureConfig
from cleargs.capture.contents import media_files
from cleargs.capture.layouts import colmap, images, llff, rgbd, transforms, video
from cleargs.capture.other_files import is_small_copy, kind_of, refused, remedy_in
from cleargs.errors import InputError
from cleargs.media import IMAGE_SUFFIXES
from cleargs.plugins import load_plugin

MIN_FRAMES = 3
"""Minimum number of frames. With two, no third frame confirms the points that they see."""

LAYOUTS: tuple[Layout, ...] = (transforms, colmap, llff, rgbd, video, images)


_TABLES = frozenset(
    f"{table}.{form}"
    for table in ("cameras", "images", "points3D", "rigs", "frames")
    for form in ("bin", "txt", "ply")
)
_LISTED = "transforms.json transforms_train.json transforms_test.json transforms_val.json poses_bounds.npy"
_TRACKED = "camera_matrix.csv odometry.csv metadata.json rgb.txt groundtruth.txt"
_LISTS = frozenset([*_LISTED.split(), *_TRACKED.split(), "project.ini"])
_MODELS = frozenset({"distorted", *(part for place in colmap.PLACES for part in place.split("/"))})
_IMAGES = frozenset({"images", "rgb", "color"})
"""Files and folders of a capture that may be given in its place."""


def whole_capture(path: Path) -> Path:
    """Return the folder of the capture to which ``path`` belongs: a file of poses, an image, a sparse model.

    Another file or folder is returned as it is.
    """
    folder = path.parent
    if path.is_dir():
        inside = {name.name for name in path.iterdir()}
        if not (inside & _TABLES or "sparse" in (path.name, *inside)) or media_files(path):
            return path
        folder = path
    elif path.suffix.lower() in IMAGE_SUFFIXES:
        known = any((folder.parent / name).exists() for name in (*_LISTS, "sparse", "masks", "depth", "pose"))
        return folder.parent if folder.name in _IMAGES and known else folder
    elif path.name not in _TABLES | _LISTS and path.suffix.lower() != ".db":
        return path
    while folder.name in _MODELS or (folder.name.isdecimal() and not media_files(folder)):
        folder = folder.parent
    return folder


def layout_of(source: Path, config: CaptureConfig) -> Layout:
    """Return the layout by ``ingest.layout``; ``auto`` is the first of `LAYOUTS` that detects ``source``."""
    if config.layout != "auto":
        named: Layout = load_plugin("layouts", config.layout)
        return named
    return next(layout for layout in LAYOUTS if layout.detect(source, config))


def externals(source: Path, config: CaptureConfig) -> Mapping[str, External]:
    """See `Layout.externals`. Raises InputError if transforms.json cannot be read."""
    return layout_of(source, config).externals(source, config)


def open_capture(source: Path, config: CaptureConfig) -> Capture:
    """Detect the layout of ``source`` and choose its frames. Decodes no frame and changes nothing.

    Raises InputError if the input does not exist, is damaged, or has too few frames.
    """
    if not source.exists():
        raise InputError(f"{source} does not exist", hint="give a video, or a folder of images")
    try:
        return _opened(source, config)
    except InputError as error:
        if source.is_file() and (kind := kind_of(source)) is not None:
            raise refused(source, *kind) from error
        raise


def _opened(source: Path, config: CaptureConfig) -> Capture:
    if is_small_copy(source):
        raise InputError(f"{source.name} is a small copy", hint="give the video to which it belongs")
    capture = layout_of(source, config).open_capture(source, config)
    if capture.kind != "video" and (config.start is not None or config.end is not None):
        raise InputError(
            f"{source} is not a video: ingest.start and ingest.end choose a part of a video",
            hint="leave them out, or give the video",
        )
    if (count := len(capture.frames)) < MIN_FRAMES:
        more = "give more images, record longer, or raise ingest.fps"
        raise InputError(
            f"{source} gives {count} frame{'s' * (count != 1)}; a scene needs at least {MIN_FRAMES}",
            hint=remedy_in(source, more) if source.is_dir() else more,
        )
    return replace(capture, frame_rate=config.frame_rate)


def frame_size(capture: Capture) -> tuple[int, int] | None:
    """Return width and height of the first frame by its camera or its file's header; None if unknown."""
    from cleargs.media.image import image_size
    from cleargs.media.video import video_size

    first = capture.frames[0]
    if first.camera is not None:
        return first.camera.width, first.camera.height
    try:
        return video_size(first.path) if capture.kind == "video" else image_size(first.path)
    except InputError:
        return None
