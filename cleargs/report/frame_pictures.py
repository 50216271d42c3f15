"""The pictures of a report's frames, as JPEGs: what was filmed, what the scene shows there, the repairs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from cleargs.media.exr import from_layer, read_exr
from cleargs.media.image import read_rgb, to_uint8
from cleargs.report.frame_strip import FrameRow
from cleargs.report.web_scene import camera_of
from cleargs.splat.viewer import Viewer

LAYERS = {
    "observed": "As filmed",
    "explained": "As the scene explains it",
    "deblurred": "Motion undone",
    "restored": "Restored",
    "fused": "Fused",
    "render": "Scene, before",
    "final": "Final scene",
}
"""Layers in the order shown -> what the page calls them."""

FOLDER = "frames"
BYTES = 8_500_000
"""About how much all layers together may take."""

_BYTES_A_PIXEL, _SIDE_MAX, _SIDE_MIN = 0.18, 960, 240  # of JPEGs at _QUALITY; px, long side
_THUMBNAIL, _QUALITY = 240, 84

RENDERED = 40
"""Most frames at which the final scene is rendered, evenly along the trajectory: more would take too long."""

Image = NDArray[np.uint8]


class Picture(NamedTuple):
    """A picture of the report, with the size it has."""

    path: str
    """Relative to the report."""
    width: int
    height: int


FramePictures = tuple[Picture, dict[str, Picture]]
"""Thumbnail of a frame, and its layers by their names in `LAYERS`."""


def write_pictures(
    rows: Sequence[FrameRow], run: Path, report: Path, final: Viewer | None, threads: int
) -> dict[int, FramePictures]:
    """Write all pictures below ``report``; ``final`` renders the last scene, where there is one."""
    (report / FOLDER).mkdir(parents=True)
    placed = [row.frame.frame_id for row in rows if final and row.frame.registered]
    rendered = set(placed[:: -(-len(placed) // RENDERED) or 1])
    layers = sum(5 if row.selection else 1 for row in rows) + len(rendered)
    side = side_of(layers, rows[0].frame.height / rows[0].frame.width if rows else 1.0, BYTES)
    # Renders come one after the other, since each uses all threads; the files are read and written meanwhile.
    with ThreadPoolExecutor(threads) as pool:
        futures = {}
        for row in rows:
            image = None
            if final and row.frame.frame_id in rendered:
                camera = camera_of(row.frame)
                smaller = camera.scaled(min(1.0, side / max(camera.width, camera.height)))
                image = final.view(smaller, row.affine)
            futures[row.frame.frame_id] = pool.submit(_write_frame, row, run, report, image, side)
        return {frame_id: future.result() for frame_id, future in futures.items()}


def side_of(pictures: int, aspect: float, budget: int, least: int = _SIDE_MIN) -> int:
    """The longer side, px, with which so many pictures (height / width: ``aspect``) take ``budget`` bytes.

    It is ``least`` where that would be too small to see anything.
    """
    pixels = budget / (_BYTES_A_PIXEL * max(pictures, 1))
    return int(np.clip(math.sqrt(pixels / min(aspect, 1 / aspect)), least, _SIDE_MAX))


def layers_of(row: FrameRow, run: Path) -> dict[str, Image]:
    """The frame as filmed, and the other layers of its latest round. Raises InputError, StoreError."""
    images = {"observed": read_rgb(run / "ingest" / row.frame.image)}
    if row.selection is not None:
        stored = read_exr(run / "rivr" / row.selection.exr).layers
        images |= {name: to_uint8(from_layer(layer)) for name, layer in stored.items() if name != "observed"}
    return images


def _write_frame(row: FrameRow, run: Path, report: Path, final: Image | None, side: int) -> FramePictures:
    images = layers_of(row, run)
    if final is not None:
        images["final"] = final
    name = f"{FOLDER}/{row.frame.frame_id:06d}"
    names = [layer for layer in LAYERS if layer in images]
    layers = {layer: write_jpeg(report, f"{name}-{layer}.jpg", images[layer], side) for layer in names}
    return write_jpeg(report, f"{name}.jpg", images["observed"], _THUMBNAIL), layers


def write_jpeg(report: Path, name: str, image: Image, side: int) -> Picture:
    """Write ``image`` reduced to at most ``side`` pixels."""
    height, width = image.shape[:2]
    factor = min(1.0, side / max(height, width))
    if factor < 1.0:
        width, height = max(1, round(width * factor)), max(1, round(height * factor))
        image = np.asarray(cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA), np.uint8)
    bgr = cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
    _, data = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY, cv2.IMWRITE_JPEG_OPTIMIZE, 1])
    (report / name).write_bytes(data.tobytes())
    return Picture(name, width, height)
