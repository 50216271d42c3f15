"""The images of the frames of a report, as JPEG files."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from cleargs.evaluate.metrics import apply_affine, fit_affine
from cleargs.evaluate.metrics import psnr as psnr_of
from cleargs.formation.frame import from_row
from cleargs.formation.motion import pixel_paths
from cleargs.formation.movement import static_pixels
from cleargs.media.exr import from_layer
from cleargs.media.image import read_mask, read_rgb, reduced, to_uint8
from cleargs.report.frames import HELD_OUT, FrameRow
from cleargs.rivr.candidates import CANDIDATES
from cleargs.scene.viewer import SceneViewer
from cleargs.scene.views import camera_of, view_of
from cleargs.splat.render import Viewer
from cleargs.types import ImageU8, MaskBool

LAYERS = {
    "observed": "As filmed",
    "paths": "Paths during the exposure",
    "explained": "Render with camera effects",
    "deblurred": "Deblurred",
    **{name: CANDIDATES[name].label for name in reversed([*CANDIDATES])},
    "masked": "Not used: masked",
    "moving": "Not used: moves",
    "final": "Final scene",
}
"""Layer -> its label on the page, in the order of the page."""

FOLDER = "frames"
IMAGE_BYTES = 8_500_000
"""Approximate limit for the total size of all layers."""

_BYTES_PER_PIXEL = 0.18  # in JPEG files at _QUALITY
_SIDE_MAX, _SIDE_MIN = 960, 240  # limits of the long side of a layer, px
_THUMBNAIL, _QUALITY = 240, 84  # long side, px; JPEG quality
_DARK, _LIGHT = (20, 20, 20), (255, 210, 60)  # border and colour of a drawn path
_UNUSED = (214, 69, 48)  # colour of pixels that no training used, sRGB

MAX_RENDERED = 40
"""Maximum number of frames with a render of the final scene, evenly along the trajectory: it limits the time.
Held-out frames are rendered in addition."""


class ImageFile(NamedTuple):
    """An image file of the report, with its size in pixels."""

    path: str
    """Path relative to the report."""
    width: int
    height: int


class FramePictures(NamedTuple):
    """The image files of a frame."""

    thumbnail: ImageFile
    layers: dict[str, ImageFile]
    """Layer, by its name in `LAYERS` -> its file."""
    psnr: float | None
    """PSNR, dB, of the final scene against a frame that was held out; None for others."""


def write_pictures(
    rows: Sequence[FrameRow],
    run: Path,
    report: Path,
    final: Viewer | None,
    scene: SceneViewer | None,
    threads: int,
) -> dict[int, FramePictures]:
    """Write the thumbnails and layers of all frames. Return frame_id -> image files.

    ``final`` renders the last scene; None without one. ``scene`` is the same scene with the image formation
    of its frames; None if it has no model of any frame.
    """
    (report / FOLDER).mkdir(parents=True)
    placed = [row.frame.frame_id for row in rows if final and row.frame.registered]
    rendered = set(placed[:: -(-len(placed) // MAX_RENDERED) or 1])
    rendered |= {row.frame.frame_id for row in rows if final and row.role == HELD_OUT}
    layers = sum(_expected_layers(row) for row in rows) + len(rendered)
    side = side_of(layers, rows[0].frame.height / rows[0].frame.width if rows else 1.0, IMAGE_BYTES)
    # Renders run one after the other, since each uses all threads. Files are read and written in parallel.
    with ThreadPoolExecutor(threads) as pool:
        futures = {}
        for row in rows:
            image, formed = None, formed_layers(row, run, scene, side)
            if final and row.frame.frame_id in rendered:
                camera = camera_of(row.frame)
                smaller = camera.scaled(min(1.0, side / max(camera.width, camera.height)))
                image = final.view(smaller, row.affine)
            futures[row.frame.frame_id] = pool.submit(_write_frame, row, run, report, image, formed, side)
        return {frame_id: future.result() for frame_id, future in futures.items()}


def side_of(pictures: int, aspect: float, budget: int, least: int = _SIDE_MIN) -> int:
    """Return the long side (px) with which JPEG files of ``aspect`` (height / width) fit in a budget.

    The ``budget`` is in bytes. The side is at least ``least``, even if the budget is then exceeded.
    """
    pixels = budget / (_BYTES_PER_PIXEL * max(pictures, 1))
    return int(np.clip(math.sqrt(pixels / min(aspect, 1 / aspect)), least, _SIDE_MAX))


def formed_layers(
    row: FrameRow, run: Path, scene: SceneViewer | None, side: int | None = None
) -> dict[str, ImageU8]:
    """Return the layers that image formation gives for a frame without an EXR; none without a model of it.

    ``scene`` is the last scene. ``side`` is the longest side of the layers, px; None for the frame's size.
    """
    tried = row.selection is not None and row.selection.exr is not None
    if scene is None or tried or not row.modelled:
        return {}
    factor = 1.0 if side is None else min(1.0, side / max(row.frame.width, row.frame.height))
    layers = scene.formed_layers(view_of(row.frame, run / "ingest", 1.0), factor)
    return {name: to_uint8(image) for name, image in layers.items()}


def layers_of(row: FrameRow, run: Path) -> dict[str, ImageU8]:
    """Return layer -> image [H, W, 3] sRGB: the frame image, its moving parts, layers of the latest round.

    Raises InputError if an image cannot be read, and StoreError for the file of the layers.
    """
    images = {"observed": read_rgb(run / "ingest" / row.frame.image)}
    observed = images["observed"]
    if row.frame.mask and not (used := read_mask(run / "ingest" / row.frame.mask) > 0).all():
        images["masked"] = _tinted(observed, used)
    if row.moving is not None:
        images["moving"] = _tinted(observed, static_pixels(row.moving, *observed.shape[:2]))
    if row.selection is not None and row.selection.exr is not None:
        stored = row.selection.layers(run / "rivr")
        images |= {name: to_uint8(from_layer(layer)) for name, layer in stored.items() if name != "observed"}
    return images


def _tinted(image: ImageU8, used: MaskBool) -> ImageU8:
    """Return an image [H, W, 3] whose pixels that are not ``used`` [H, W] are tinted."""
    tint = np.where(used[..., None], image, _UNUSED).astype(np.uint8)
    return np.asarray(cv2.addWeighted(image, 0.4, tint, 0.6, 0.0), np.uint8)


def _expected_layers(row: FrameRow) -> int:
    masked = int(row.frame.mask is not None)
    if row.selection is not None and row.selection.exr is not None:
        return masked + (6 if row.modelled else 5)
    return masked + (4 if row.modelled else 1)


def _write_frame(
    row: FrameRow, run: Path, report: Path, final: ImageU8 | None, formed: Mapping[str, ImageU8], side: int
) -> FramePictures:
    images = {**layers_of(row, run), **formed}
    if row.modelled:
        images["paths"] = with_paths(images["observed"], row)
    if final is not None:
        images["final"] = final
    name = f"{FOLDER}/{row.frame.frame_id:06d}"
    names = [layer for layer in dict.fromkeys((*LAYERS, *images)) if layer in images]
    layers = {layer: write_jpeg(report, f"{name}-{layer}.jpg", images[layer], side) for layer in names}
    unseen = _aligned_psnr(final, images["observed"]) if final is not None and row.role == HELD_OUT else None
    return FramePictures(write_jpeg(report, f"{name}.jpg", images["observed"], _THUMBNAIL), layers, unseen)


def _aligned_psnr(render: ImageU8, observed: ImageU8) -> float | None:
    """Return the PSNR, dB, of a render against the frame image, after the best affine change of colours."""
    height, width = render.shape[:2]
    reference = np.asarray(cv2.resize(observed, (width, height), interpolation=cv2.INTER_AREA), np.uint8)
    image, target = render / 255.0, reference / 255.0
    return psnr_of(to_uint8(apply_affine(image, fit_affine(image, target, None))), reference)


def with_paths(image: ImageU8, row: FrameRow) -> ImageU8:
    """Return an image of a frame with the paths of some of its pixels during the exposure, true to scale."""
    camera = camera_of(row.frame)
    motion = from_row({**row.formation, "frame_id": row.frame.frame_id}).motion
    shape = (3, 4) if camera.width >= camera.height else (4, 3)
    paths = pixel_paths(motion, camera, shape, np.linspace(-0.5, 0.5, 33))
    rows, columns = np.indices(shape) + 0.5
    centres = np.stack([columns / shape[1] * camera.width, rows / shape[0] * camera.height], -1)
    lines = (paths + centres).reshape(len(paths), -1, 2).swapaxes(0, 1)
    drawn, unit = image.copy(), max(1, round(max(camera.width, camera.height) / 480))
    fixed = [np.rint(8 * line).astype(np.int32) for line in lines]  # in eighths of a pixel
    for colour, width in ((_DARK, 3 * unit), (_LIGHT, unit)):
        cv2.polylines(
            drawn, fixed, isClosed=False, color=colour, thickness=width, lineType=cv2.LINE_AA, shift=3
        )
    return drawn


def write_jpeg(report: Path, name: str, image: ImageU8, side: int) -> ImageFile:
    """Write ``image`` [H, W, 3] sRGB to a JPEG file of the report, at most ``side`` px wide or high."""
    small = reduced(image, side)
    bgr = cv2.cvtColor(small, cv2.COLOR_RGB2BGR)
    _, data = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY, cv2.IMWRITE_JPEG_OPTIMIZE, 1])
    (report / name).write_bytes(data.tobytes())
    return ImageFile(name, small.shape[1], small.shape[0])
