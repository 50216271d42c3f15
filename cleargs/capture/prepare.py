"""Working images: every chosen frame upright, in sRGB, as PNG, at the size at which COLMAP sees it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from cleargs.capture.behind import StillRoom, still_room
from cleargs.capture.cameras import Intrinsics
from cleargs.capture.capture import Capture, SourceFrame
from cleargs.capture.cutouts import are_cut_outs, resampled
from cleargs.capture.neighbours import Gatherer, Neighbourhood, neighbourhoods
from cleargs.capture.overlay import without_scene, wraps_around
from cleargs.errors import InputError
from cleargs.files import make_folder, remove
from cleargs.media.image import (
    image_size,
    is_panorama,
    orientation,
    read_alpha,
    read_mask,
    read_rgb,
    read_transparency,
    reduced,
    write_mask,
    write_rgb,
)
from cleargs.media.video import decode_with_grey
from cleargs.progress import Reporter
from cleargs.types import ImageU8, MaskU8

_PANORAMAS = 3  # number of pictures that are tested for a panorama
_COARSEST_MASK = 8  # maximum number of image pixels per mask pixel, along a side


@dataclass(frozen=True)
class WorkFrame:
    """One frame as COLMAP sees it; ``camera`` (of the input, if any) fits the working image."""

    source: SourceFrame
    image: str
    """File name below the folder of working images."""
    width: int
    height: int
    masked: bool
    camera: Intrinsics | None
    transparent: bool = False
    """True if the mask of the frame is the transparency of its image."""
    cut_out: bool = False
    """True if transparent pixels are empty; the alpha is below the folder of alphas, named like the image."""
    movers: tuple[tuple[int, int, int, int], ...] | None = None
    """Boxes of what may move (left, top, right, bottom, px); None: not looked for. See `movers`."""


def prepare(capture: Capture, folder: Path, long_side: int, reporter: Reporter) -> list[WorkFrame]:
    """Write the working images ``folder/images/%06d.png`` and their masks ``folder/masks/%06d.png.png``.

    The frames around those of a video, see `neighbour_file`, are decoded with them. The names of masks are
    COLMAP's. Images are reduced to ``long_side`` px, never enlarged. Intact images of
    a killed run stay. Raises InputError for an unreadable image, an image without the proportions of its
    camera, or a panorama.
    """
    images, masks, alphas = folder / "images", folder / "masks", folder / "alphas"
    make_folder(images)
    make_folder(masks)
    paths = [images / f"{index:06d}.png" for index in range(len(capture.frames))]
    pairs = list(zip(capture.frames, paths, strict=True))
    cut_out = all(frame.pts is None for frame in capture.frames) and are_cut_outs(
        [frame.path for frame in capture.frames]
    )
    if cut_out:
        make_folder(alphas)
    with reporter.task("reading frames", len(paths)) as task:
        todo = {path: frame for frame, path in pairs if not _is_intact(path, reporter)}
        task.update(done=len(paths) - len(todo))
        for path, rgb in _pictures(todo, _gathered(capture, folder), long_side):
            if cut_out:
                alpha = read_transparency(todo[path].path, upright=not is_as_stored(todo[path]))
                assert alpha is not None  # `are_cut_outs`
                rgb, alpha = resampled(rgb, alpha, lambda picture: reduced(picture, long_side))
                write_mask(alphas / path.name, alpha)
            write_rgb(path, reduced(rgb, long_side))
            task.advance()
    if all(
        (frame.pts is None and is_panorama(frame.path)) or wraps_around(read_rgb(path))
        for frame, path in pairs[:_PANORAMAS]
    ):
        raise InputError(
            "the pictures are equirectangular panoramas, which show all directions",
            hint="cut perspective views out of them first (ffmpeg's filter v360 does), and give these",
        )
    unused = None if cut_out else without_scene(paths)
    if unused is not None and unused.border.any():
        reporter.warn(
            f"{unused.border.mean():.1%} of the pixels are a border around the picture (bars, a lens hood): "
            "masked in all frames"
        )
    if unused is not None and unused.still.any():
        reporter.warn(
            f"{unused.still.mean():.1%} of the pixels never move (text, a logo or a bar in the pictures): "
            "masked in all frames"
        )
    still = None if unused is None else unused.mask
    room = None if cut_out else still_room(paths)
    if room is not None:
        reporter.warn(
            f"two motions: {room.share:.0%} of the picture is still in most frames (the room of a turntable, "
            "a dashboard, a screen), and the rest moves. The still part is masked, the rest is reconstructed"
        )
    prepared = [
        _work_frame(frame, path, masks / f"{path.name}.png", _unseen(path, still, room))
        for frame, path in pairs
    ]
    if cut_out:
        prepared = [replace(made, cut_out=True) for made in prepared]
    if any(made.masked for made in prepared):
        for made in prepared:  # COLMAP leaves out an image without a mask if others have one
            mask = masks / f"{made.image}.png"
            if not mask.is_file():
                write_mask(mask, np.full((made.height, made.width), 255, np.uint8))
    transparent = sum(made.transparent for made in prepared)
    if transparent:
        what = "empty there" if cut_out else "ignored, like masks"
        reporter.info(f"{transparent} of {len(prepared)} images are transparent in places: {what}")
    return prepared


def _unseen(path: Path, still: MaskU8 | None, room: StillRoom | None) -> MaskU8 | None:  # [H, W]
    """Return the mask of the working image ``path`` without its still parts, or None."""
    if room is None:
        return still
    mask = room.mask(read_rgb(path))
    return mask if still is None else np.minimum(mask, still)


def _is_intact(image: Path, reporter: Reporter) -> bool:
    """Return True if a killed run left ``image`` intact. A damaged file is removed with a warning."""
    if image.is_symlink() or image.exists():
        try:
            return len(read_rgb(image)) > 0
        except InputError:
            reporter.warn(f"the damaged working file {image.parent.name}/{image.name} is written again")
            remove(image)
    return False


def neighbour_file(folder: Path, number: int) -> Path:
    """Return the file of the pictures around the frame ``number`` of a video, see `neighbours.Gatherer`."""
    return folder / "neighbours" / f"{number:06d}.npy"


def _gathered(capture: Capture, folder: Path) -> dict[Path, Gatherer]:
    """Return video -> gatherer of the pictures around its chosen frames that a killed run did not write."""
    if capture.kind != "video":
        return {}
    make_folder(folder / "neighbours")
    of_video: dict[Path, dict[Path, tuple[Neighbourhood, SourceFrame]]] = {}
    for one in neighbourhoods(capture):
        chosen, file = capture.frames[one.number], neighbour_file(folder, one.number)
        if not file.exists():
            of_video.setdefault(chosen.path, {})[file] = one, chosen
    return {video: Gatherer(around) for video, around in of_video.items()}


def _pictures(
    frames: Mapping[Path, SourceFrame], gathered: Mapping[Path, Gatherer], long_side: int
) -> Iterator[tuple[Path, ImageU8]]:
    """Yield the keys and pictures of ``frames``. Each video is decoded once, also for ``gathered``."""
    of_video: dict[Path, dict[int, Path]] = {video: {} for video in gathered}
    for key, frame in frames.items():
        if frame.pts is None:
            yield key, read_image(frame)
        else:
            of_video.setdefault(frame.path, {})[frame.pts] = key
    for video, keys in of_video.items():
        gatherer = gathered.get(video)
        for pts, rgb, grey in decode_with_grey(video, keys, gatherer.stamps if gatherer else ()):
            if gatherer and grey is not None:
                gatherer.add(pts, reduced(grey, long_side))
            if rgb is not None:
                yield keys[pts], rgb


def read_image(frame: SourceFrame) -> ImageU8:  # [H, W, 3]
    """Return the image, turned by its EXIF orientation unless the frame's camera fits the stored image."""
    return read_rgb(frame.path, upright=not is_as_stored(frame))


def is_as_stored(frame: SourceFrame) -> bool:
    """Return True if the frame's camera fits the stored image, on which COLMAP works.

    A half turn keeps the proportions. Then the camera counts as fitting.
    """
    camera = frame.camera
    return camera is not None and _alike(camera.width, camera.height, image_size(frame.path))


def _alike(width: int, height: int, size: tuple[int, int]) -> bool:
    """Return True if width and height have the proportions of ``size``, up to rounding to whole pixels."""
    w, h = size
    return bool(abs(w * height - h * width) <= max(width, height) + max(w, h))


def _work_frame(frame: SourceFrame, image: Path, mask: Path, still: MaskU8 | None) -> WorkFrame:
    width, height = image_size(image)
    camera = frame.camera
    if camera is not None:
        if not _alike(camera.width, camera.height, (width, height)):
            raise InputError(
                f"{frame.name} does not have the proportions of its camera ({camera.width}x{camera.height})",
                hint="give the images that the poses were made from, or set ingest.poses=sfm",
            )
        camera = camera.resized(width, height)
    source_mask = read_source_mask(frame)
    still = still if still is not None and still.shape == (height, width) else None
    masked = source_mask is not None or still is not None
    if masked:
        write_mask(mask, _resized_mask(frame, source_mask, still, width, height))
    transparent = source_mask is not None and frame.mask is None
    return WorkFrame(frame, image.name, width, height, masked, camera, transparent)


def _resized_mask(
    frame: SourceFrame, source_mask: MaskU8 | None, still: MaskU8 | None, width: int, height: int
) -> MaskU8:  # [height, width]
    """Return the mask of a working image: 0 where its own mask or that of still parts is 0."""
    mask = np.full((height, width), 255, np.uint8) if still is None else still
    if source_mask is None:
        return mask
    # Rounded to whole pixels, a mask of one pixel has any proportions.
    coarse = _COARSEST_MASK * min(source_mask.shape) < min(width, height)
    if coarse or not _alike(source_mask.shape[1], source_mask.shape[0], (width, height)):
        what = "is far smaller than it" if coarse else "does not have its proportions"
        raise InputError(f"the mask of {frame.name} {what}", hint="make masks of the size of their images")
    own = np.asarray(cv2.resize(source_mask, (width, height), interpolation=cv2.INTER_NEAREST))
    return np.minimum(mask, own)


def read_source_mask(frame: SourceFrame) -> MaskU8 | None:
    """Return the mask of the frame, else the transparency of its image; None if all pixels count."""
    if frame.mask is not None:
        return read_mask(frame.mask, _turn_of_mask(frame, frame.mask))
    return None if frame.pts is not None else read_alpha(frame.path, upright=not is_as_stored(frame))


def _turn_of_mask(frame: SourceFrame, mask: Path) -> int:
    """Return the EXIF orientation by which ``mask`` is turned with its image; 1 if it fits the upright image.

    The proportions decide. If they are the same, as for half turns and squares, a mask with the full name
    of its image (COLMAP's form, and COLMAP turns no image) is one of the stored pixels, another one is not.
    """
    turn = 1 if frame.pts is not None or is_as_stored(frame) else orientation(frame.path)
    if turn == 1:
        return 1
    stored, made = image_size(frame.path), image_size(mask)
    fits = _alike(*made, stored[::-1] if turn >= 5 else stored), _alike(*made, stored)
    return turn if fits == (False, True) or (all(fits) and mask.stem == frame.path.name) else 1
