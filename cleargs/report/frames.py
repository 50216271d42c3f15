"""The frames of a report: their data from the tables of the stages, and their images as JPEG files."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from cleargs.capture.tables import Frame, load_frames
from cleargs.formation.exposure import read_exposure
from cleargs.formation.frame import from_row
from cleargs.formation.frames import view_of
from cleargs.formation.motion import pixel_paths
from cleargs.formation.table import FORMATION
from cleargs.media.exr import from_layer
from cleargs.media.image import read_rgb, to_uint8
from cleargs.parquet import read_any_table, read_table
from cleargs.rivr.distillation import TrainedScene
from cleargs.rivr.tables import Selection, read_selection
from cleargs.rva.tables import FRAMES
from cleargs.splat.camera import Camera
from cleargs.splat.render import Viewer
from cleargs.types import ImageU8

HELD_OUT, UNPLACED = "held out", "not placed"
"""Roles, on the page, of frames that RVA does not rate."""

CHOICES = {
    "render": "the render",
    "restored": "the restored frame",
    "fused": "the fusion of render and restored frame",
    "observed": "none: the raw frame is kept",
}
"""Candidate -> its description in the report."""

MEANINGS = {column.name: column.metadata[b"meaning"].decode() for column in FORMATION}
"""Column of ``formation.parquet`` -> its meaning."""


@dataclass(frozen=True)
class FrameRow:
    """One frame, with the results of the stages for it."""

    frame: Frame
    judged: Mapping[str, Any] = field(default_factory=dict)
    """The row of the frame in ``rva/frames.parquet``; empty without one."""
    rounds: tuple[Selection, ...] = ()
    """The rows of the frame in ``rivr/selection.parquet``, in the order of the rounds."""
    affine: NDArray[np.float64] | None = None  # [3, 4]
    """Transform of sRGB colours from the last scene to the frame; None without exposure compensation."""
    formation: Mapping[str, Any] = field(default_factory=dict)
    """Column of ``formation.parquet`` of the last scene -> value; empty without one."""

    @property
    def role(self) -> str:
        """Role by RVA, `HELD_OUT` or `UNPLACED`; "" if it is unknown."""
        if not self.frame.registered:
            return UNPLACED
        return HELD_OUT if self.frame.split != "train" else str(self.judged.get("role", ""))

    @property
    def weight(self) -> float | None:
        """Weight of the raw frame in training, from 0 to 1."""
        return self.judged.get("weight")

    @property
    def selection(self) -> Selection | None:
        """Row of the latest round."""
        return self.rounds[-1] if self.rounds else None

    @property
    def chosen(self) -> str | None:
        """Candidate of the latest round that the training uses; None if it was refused."""
        if self.selection is None:
            return None
        used = self.selection.accepted or self.selection.chosen == "observed"
        return self.selection.chosen if used else None

    @property
    def modelled(self) -> bool:
        """True where the last scene has a model of what the camera did to the frame."""
        return self.formation.get("model", "none") != "none" and self.frame.registered

    @property
    def gain_ev(self) -> float | None:
        """Exposure relative to the scene at middle grey, in stops; None without compensation."""
        if self.affine is None:
            return None
        grey = self.affine[:, :3].sum(axis=1) * 0.5 + self.affine[:, 3]
        # Near middle grey, linear light is about the sRGB value to the power of 2.4. A stop is a factor of 2.
        return 2.4 * math.log2(max(float(grey.mean()), 1e-3) / 0.5)

    def motion(self, name: Literal["blur_px", "skew_px"]) -> float | None:
        """Return the fitted motion blur, or the rolling shutter between first and last line, in pixels."""
        found: float | None = self.formation.get(name, getattr(self.selection, name, None))
        return found


def scene_with_models(rows: Sequence[FrameRow], run: Path, stages: Collection[str]) -> TrainedScene | None:
    """Return the last scene of ``run`` where it has a model of any of ``rows``, else None.

    Raises:
        StoreError: A file of the scene is damaged.
    """
    last = last_scene(stages)
    return TrainedScene(run / last) if last and any(row.modelled for row in rows) else None


def scores_of(selection: Selection) -> list[tuple[str, dict[str, float]]]:
    """Return the deciding scorer, then the scorer for ties, each as (name, candidate -> score)."""
    found = []
    for use in ("primary", "tiebreak") if selection.exr is not None else ():
        scores = {name: getattr(selection, f"{use}_{name}") for name in CHOICES}
        known = {name: score for name, score in scores.items() if score is not None}
        found.append((getattr(selection, f"{use}_metric"), known))
    return found


SCENES = ("g0", "rivr", "consolidate")
"""Stages that train a scene, in order."""


def last_scene(stages: Collection[str]) -> str | None:
    """Return the last of ``stages`` that trains a scene; None without one."""
    return next((stage for stage in reversed(SCENES) if stage in stages), None)


def load_rows(run: Path, stages: Collection[str]) -> list[FrameRow]:
    """Read the data of all frames of a run.

    Args:
        run: The run folder.
        stages: The finished stages.

    Returns:
        One row per frame, in the order of the capture.

    Raises:
        StoreError: if a table cannot be read.
    """
    judged: dict[int, dict[str, Any]] = {}
    if "rva" in stages:
        rows = read_table(run / "rva" / "frames.parquet", FRAMES).to_pylist()
        judged = {row["frame_id"]: row for row in rows}
    rounds: dict[int, list[Selection]] = {}
    if "rivr" in stages:
        for found in sorted(read_selection(run / "rivr" / "selection.parquet"), key=lambda row: row.round):
            rounds.setdefault(found.frame_id, []).append(found)
    affines: dict[int, NDArray[np.float64]] = {}
    formation: dict[int, dict[str, Any]] = {}  # stays empty if image formation is off
    if final := last_scene(stages):
        exposure = read_exposure(run / final / "exposure.parquet")
        if exposure.enabled:
            affines = dict(zip(exposure.frame_ids.tolist(), exposure.affines, strict=True))
        if (path := run / final / "formation.parquet").is_file():
            formation = {row.pop("frame_id"): row for row in read_any_table(path).to_pylist()}
    return [
        FrameRow(
            frame,
            judged.get(frame.frame_id, {}),
            tuple(rounds.get(frame.frame_id, ())),
            affines.get(frame.frame_id),
            formation.get(frame.frame_id, {}),
        )
        for frame in load_frames(run / "ingest")
    ]


def camera_of(frame: Frame) -> Camera:
    """Return the camera of a frame with a pose."""
    return view_of(frame, Path(), 0.0).camera


# -- images --------------------------------------------------------------------------------------------------


LAYERS = {
    "observed": "As filmed",
    "paths": "Paths during the exposure",
    "explained": "Render with camera effects",
    "deblurred": "Deblurred",
    "restored": "Restored",
    "fused": "Fused",
    "render": "Scene before repair",
    "final": "Final scene",
}
"""Layer -> its label on the page, in the order of the page."""

FOLDER = "frames"
IMAGE_BYTES = 8_500_000
"""Approximate limit for the total size of all layers."""

_BYTES_PER_PIXEL = 0.18  # in JPEG files at _QUALITY
_SIDE_MAX, _SIDE_MIN = 960, 240  # limits of the long side of a layer, px
_THUMBNAIL, _QUALITY = 240, 84  # long side, px; JPEG quality
_DARK, _LIGHT = (20, 20, 20), (255, 210, 60)  # colours of the border of a drawn path, and of the path

MAX_RENDERED = 40
"""Maximum number of frames, evenly along the trajectory, for which the final scene is rendered. It limits the
time."""


class ImageFile(NamedTuple):
    """An image file of the report, with its size in pixels."""

    path: str
    """Path relative to the report."""
    width: int
    height: int


FramePictures = tuple[ImageFile, dict[str, ImageFile]]
"""Thumbnail of a frame, and its layers by their names in `LAYERS`."""


def write_pictures(
    rows: Sequence[FrameRow],
    run: Path,
    report: Path,
    final: Viewer | None,
    scene: TrainedScene | None,
    threads: int,
) -> dict[int, FramePictures]:
    """Write the thumbnails and layers of all frames.

    Args:
        rows: The frames.
        run: The run folder.
        report: Folder of the report.
        final: Renderer of the last scene; None without one.
        scene: The same scene with the formations of its frames; None without a model of any.
        threads: Number of threads.

    Returns:
        frame_id -> image files.
    """
    (report / FOLDER).mkdir(parents=True)
    placed = [row.frame.frame_id for row in rows if final and row.frame.registered]
    rendered = set(placed[:: -(-len(placed) // MAX_RENDERED) or 1])
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
    """Return the long side, in pixels, with which all images fit into a limit.

    Args:
        pictures: Number of images.
        aspect: Height divided by width.
        budget: Limit for the total size of the JPEG files, in bytes.
        least: Minimum of the long side, even if the limit is then exceeded.
    """
    pixels = budget / (_BYTES_PER_PIXEL * max(pictures, 1))
    return int(np.clip(math.sqrt(pixels / min(aspect, 1 / aspect)), least, _SIDE_MAX))


def formed_layers(
    row: FrameRow, run: Path, scene: TrainedScene | None, side: int | None = None
) -> dict[str, ImageU8]:
    """Return the layers of a frame that no EXR holds, computed from its formation; none without a model.

    Args:
        row: The frame.
        run: The run folder.
        scene: The last scene.
        side: Longest side of the layers, px; None for the frame's.
    """
    tried = row.selection is not None and row.selection.exr is not None
    if scene is None or tried or not row.modelled:
        return {}
    factor = 1.0 if side is None else min(1.0, side / max(row.frame.width, row.frame.height))
    layers = scene.formed_layers(view_of(row.frame, run / "ingest", 1.0), factor)
    return {name: to_uint8(image) for name, image in layers.items()}


def layers_of(row: FrameRow, run: Path) -> dict[str, ImageU8]:
    """Return layer -> image [H, W, 3] sRGB: the raw frame, and the other layers of its latest round.

    Raises:
        InputError: if an image cannot be read.
        StoreError: if the file of the layers cannot be read.
    """
    images = {"observed": read_rgb(run / "ingest" / row.frame.image)}
    if row.selection is not None and row.selection.exr is not None:
        stored = row.selection.layers(run / "rivr")
        images |= {name: to_uint8(from_layer(layer)) for name, layer in stored.items() if name != "observed"}
    return images


def _expected_layers(row: FrameRow) -> int:
    """Return how many layers a frame has besides the final scene."""
    if row.selection is not None and row.selection.exr is not None:
        return 6 if row.modelled else 5
    return 4 if row.modelled else 1


def _write_frame(
    row: FrameRow,
    run: Path,
    report: Path,
    final: ImageU8 | None,
    formed: Mapping[str, ImageU8],
    side: int,
) -> FramePictures:
    images = {**layers_of(row, run), **formed}
    if row.modelled:
        images["paths"] = with_paths(images["observed"], row)
    if final is not None:
        images["final"] = final
    name = f"{FOLDER}/{row.frame.frame_id:06d}"
    names = [layer for layer in LAYERS if layer in images]
    layers = {layer: write_jpeg(report, f"{name}-{layer}.jpg", images[layer], side) for layer in names}
    return write_jpeg(report, f"{name}.jpg", images["observed"], _THUMBNAIL), layers


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
    """Write a JPEG file whose long side has at most ``side`` pixels.

    Args:
        report: Folder of the report.
        name: Path of the file relative to ``report``.
        image: The image [H, W, 3], sRGB.
        side: Maximum of the long side, in pixels.
    """
    height, width = image.shape[:2]
    factor = min(1.0, side / max(height, width))
    if factor < 1.0:
        width, height = max(1, round(width * factor)), max(1, round(height * factor))
        image = np.asarray(cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA), np.uint8)
    bgr = cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
    _, data = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY, cv2.IMWRITE_JPEG_OPTIMIZE, 1])
    (report / name).write_bytes(data.tobytes())
    return ImageFile(name, width, height)
