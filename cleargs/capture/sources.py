"""What a capture consists of: its frames in order, with the cameras and poses that the input brings."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from cleargs.capture.cameras import Camera, Pose
from cleargs.capture.config import IngestConfig
from cleargs.capture.layout import (
    Layout,
    find_model,
    folder_kind,
    image_files,
    lies_below,
    mask_folder,
    source_of_images,
)
from cleargs.capture.llff import read_llff
from cleargs.capture.model import SparseModel, read_model
from cleargs.capture.transforms import TransformsFrame, read_transforms
from cleargs.errors import InputError
from cleargs.media.image import image_size
from cleargs.media.video import Timeline, read_timeline, video_size
from cleargs.plugins import load_part

T = TypeVar("T")

MIN_FRAMES = 3
"""Two frames have no third to confirm what they see."""


@dataclass(frozen=True)
class SourceFrame:
    """One frame as the input has it."""

    name: str
    path: Path
    """Image file, or the video."""
    pts: int | None = None
    """Presentation time stamp, for a frame of a video."""
    time_s: float | None = None
    mask: Path | None = None
    camera: Camera | None = None
    pose: Pose | None = None


@dataclass(frozen=True)
class Capture:
    """The chosen frames of an input, in trajectory order."""

    kind: str
    """video, images, colmap, llff, transforms, or what the layout of another package says."""
    frames: tuple[SourceFrame, ...]
    n_available: int
    """Frames in the input, before choosing."""
    model: SparseModel | None = None
    """The sparse model of a COLMAP project, where it has points."""
    hdr: str | None = None
    """``pq`` or ``hlg`` for an HDR video, which is tone-mapped."""

    @property
    def posed(self) -> bool:
        return any(frame.pose is not None for frame in self.frames)


def open_capture(source: Path, config: IngestConfig) -> Capture:
    """Find out what ``source`` is and choose its frames. Decodes no frame; changes nothing.

    A folder with transforms.json is taken for that; else one with a sparse model for a COLMAP project; else
    one with poses_bounds.npy for LLFF's; else its images (those in ``images/``, its own, or those in the
    largest ``images_N/``) are taken in the order of `frame_key`. Raises InputError.
    """
    if not source.exists():
        raise InputError(f"{source} does not exist", hint="give a video, or a folder of images")
    if config.layout != "auto":
        layout: Layout = load_part("layouts", config.layout)
        capture = layout.open_capture(source, config)
    elif not source.is_dir():
        return _open_video(source, config)
    else:
        opener = {
            "transforms": _open_transforms,
            "colmap": _open_colmap,
            "llff": _open_llff,
            "images": _open_images,
        }[folder_kind(source, poses=config.poses == "auto")]
        capture = opener(source, config)
    if len(capture.frames) < MIN_FRAMES:
        raise InputError(
            f"{source} has {len(capture.frames)} frames; a scene needs at least {MIN_FRAMES}",
            hint="give more images, or raise ingest.fps",
        )
    return capture


def frame_size(capture: Capture) -> tuple[int, int] | None:
    """Width and height of the first frame by its camera or its file's header; None where neither says."""
    first = capture.frames[0]
    if first.camera is not None:
        return first.camera.width, first.camera.height
    try:
        return video_size(first.path) if capture.kind == "video" else image_size(first.path)
    except InputError:
        return None


def natural_key(text: str) -> list[tuple[int, int, str]]:
    """Sort key by which ``2.jpg`` comes before ``10.jpg``."""
    parts = re.split(r"(\d+)", text)
    return [(1, int(part), "") if part.isdigit() else (0, 0, part.lower()) for part in parts]


def frame_key(name: str) -> tuple[list[tuple[int, int, str]], str]:
    """Sort key of frames: `natural_key`, but ``train_`` and ``eval_`` before the file's name do not count.

    3dgs-deblur marks its split so (train_frame_00001.png, eval_frame_00002.png); sorted with these prefixes,
    the test frames would all come before the others, out of the order in which they were taken.
    """
    return natural_key(re.sub(r"(?<![^/])(train|eval)_(?=[^/]*$)", "", name)), name


def spread(items: Sequence[T], at_most: int) -> list[T]:
    """At most so many of ``items``, evenly by position, first and last included."""
    if len(items) <= at_most:
        return list(items)
    return [items[int(index)] for index in np.rint(np.linspace(0, len(items) - 1, at_most))]


def _open_video(source: Path, config: IngestConfig) -> Capture:
    timeline = read_timeline(source)
    chosen = choose_times(timeline, config.fps, config.max_frames)
    if len(chosen) < MIN_FRAMES:
        raise InputError(
            f"{source.name} gives {len(chosen)} frames; a scene needs at least {MIN_FRAMES}",
            hint="record longer, or raise ingest.fps or ingest.max_frames",
        )
    frames = tuple(video_frame(source, timeline, index) for index in chosen)
    return Capture("video", frames, len(timeline.pts), hdr=timeline.transfer)


def video_frame(source: Path, timeline: Timeline, index: int) -> SourceFrame:
    """Frame ``index`` of a video."""
    name = f"{source.stem}_{index:06d}"
    return SourceFrame(name, source, pts=timeline.pts[index], time_s=timeline.seconds(index))


def choose_times(timeline: Timeline, fps: float | None, at_most: int) -> list[int]:
    """Frame numbers evenly in time (not in number: the frame rate may vary): every 1 / fps seconds if given,
    and at most so many from first to last."""
    times = np.array([timeline.seconds(index) for index in range(len(timeline.pts))])
    span = float(times[-1])
    chosen = (
        list(range(len(times)))
        if fps is None
        else _nearest(times, np.arange(int(span * fps + 1e-6) + 1) / fps)
    )
    return chosen if len(chosen) <= at_most else _nearest(times, np.linspace(0, span, at_most))


def _nearest(times: NDArray[np.float64], wanted: NDArray[np.float64]) -> list[int]:
    """Numbers of the frames nearest to the wanted times, each once; ``times`` start at 0 and ascend."""
    after = np.minimum(np.searchsorted(times, wanted), len(times) - 1)
    before = np.maximum(after - 1, 0)
    nearest = np.where(wanted - times[before] <= times[after] - wanted, before, after)
    return sorted({int(index) for index in nearest})


def _open_transforms(source: Path, config: IngestConfig) -> Capture:
    listed = read_transforms(source / "transforms.json", poses=config.poses == "auto")
    listed.sort(key=lambda frame: frame_key(frame.name))
    masks = masks_of(mask_folder(source), [name_below_images(frame) for frame in listed])
    frames = tuple(
        SourceFrame(
            frame.name,
            frame.path,
            mask=frame.mask or masks.get(name_below_images(frame)),
            camera=frame.camera,
            pose=frame.pose,
        )
        for frame in spread(listed, config.max_frames)
    )
    return Capture("transforms", frames, len(listed))


def _open_llff(source: Path, config: IngestConfig) -> Capture:
    # In the order of the rows: the test views of these data sets are every N-th row.
    views = read_llff(source)
    masks = masks_of(mask_folder(source), [view.path.name for view in views])
    frames = tuple(
        SourceFrame(
            view.path.name,
            view.path,
            mask=masks.get(view.path.name),
            camera=view.camera,
            pose=view.pose,
        )
        for view in spread(views, config.max_frames)
    )
    return Capture("llff", frames, len(views))


def _open_images(source: Path, config: IngestConfig) -> Capture:
    files = sorted(image_files(source_of_images(source)), key=lambda path: frame_key(path.name))
    if not files:
        raise InputError(
            f"{source} holds no images, no video and no transforms.json",
            hint="give a video, a folder of images, a COLMAP project, or a folder with transforms.json",
        )
    masks = masks_of(mask_folder(source), [path.name for path in files])
    frames = tuple(
        SourceFrame(path.name, path, mask=masks.get(path.name)) for path in spread(files, config.max_frames)
    )
    return Capture("images", frames, len(files))


def _open_colmap(source: Path, config: IngestConfig) -> Capture:
    folder = find_model(source)
    assert folder is not None
    model = read_model(folder)
    root = source / "images"
    if not root.is_dir():
        raise InputError(f"{source} has a sparse model but no images/", hint="put the images into images/")
    posed = {image.name: image for image in model.images.values()}
    outside = [name for name in posed if not lies_below(name)]
    if outside:
        raise InputError(
            f"the COLMAP model lists images outside images/ or hidden in it, such as {outside[0]}",
            hint="put them into images/ and export the model again, or set ingest.poses=sfm",
        )
    missing = [name for name in posed if not (root / name).is_file()]
    if missing:
        raise InputError(
            f"the COLMAP model lists images that do not exist, such as {missing[0]} ({len(missing)} in all)",
            hint="put the images that the model was made from into images/, or set ingest.poses=sfm",
        )
    # Images that COLMAP could not register are frames too: they stay in the table, marked.
    stored = {path.relative_to(root).as_posix() for path in image_files(root, below=True)}
    names = sorted(set(posed) | stored, key=frame_key)
    masks = masks_of(mask_folder(source), names)
    frames = []
    for name in spread(names, config.max_frames):
        image = posed.get(name)
        if image is not None and image.camera_id not in model.cameras:
            raise InputError(
                f"the COLMAP model has no camera for {name}", hint="export it again, or set ingest.poses=sfm"
            )
        camera = model.cameras[image.camera_id] if image is not None else None
        pose = image.pose if image is not None else None
        frames.append(SourceFrame(name, root / name, mask=masks.get(name), camera=camera, pose=pose))
    return Capture(
        "colmap", tuple(frames), len(names), model if len(model.point_ids) or model.dropped else None
    )


def name_below_images(frame: TransformsFrame) -> str:
    """The name of a frame's image by its place below ``images/``."""
    return PurePosixPath(frame.name).as_posix().removeprefix("images/")


def masks_of(folder: Path | None, names: Sequence[str]) -> dict[str, Path]:
    """The masks in ``folder`` of the images of these ``names``: in the same place, by stem or full name (as
    COLMAP has them); elsewhere where no other image has that stem."""
    if folder is None:
        return {}
    found = {
        path.relative_to(folder).with_suffix("").as_posix(): path for path in image_files(folder, below=True)
    }
    stems = Counter(PurePosixPath(name).stem for name in names)
    masks = {}
    for name in names:
        path = PurePosixPath(name)
        spellings = [path.with_suffix("").as_posix(), name]
        spellings += [path.stem, path.name] if stems[path.stem] == 1 else []
        mask = next((found[spelling] for spelling in spellings if spelling in found), None)
        if mask is not None:
            masks[name] = mask
    return masks
