"""The frames of a report: the rows of its strip, joined from the tables of the stages, and their pictures.

The pictures are JPEGs of what was filmed, of what the scene shows there, and of the repairs.
"""

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
from cleargs.formation.frames import view_of
from cleargs.formation.table import FORMATION
from cleargs.media.exr import from_layer, read_exr
from cleargs.media.image import read_rgb, to_uint8
from cleargs.parquet import read_any_table, read_table
from cleargs.rivr.tables import Selection, read_selection
from cleargs.rva.tables import FRAMES
from cleargs.splat.camera import Camera
from cleargs.splat.render import Viewer
from cleargs.types import ImageU8

HELD_OUT, UNPLACED = "held out", "not placed"
"""Roles of frames on which RVA has nothing to say."""

CHOICES = {
    "render": "the render",
    "restored": "the restored frame",
    "fused": "render and restored frame, fused",
    "observed": "none: the raw frame is kept",
}

MEANINGS = {column.name: column.metadata[b"meaning"].decode() for column in FORMATION}
"""Column of ``formation.parquet`` -> what it means."""


@dataclass(frozen=True)
class FrameRow:
    """One frame, and what the stages say of it."""

    frame: Frame
    judged: Mapping[str, Any] = field(default_factory=dict)
    """Its row of ``rva/frames.parquet``; empty without one."""
    rounds: tuple[Selection, ...] = ()
    """Its rows of ``rivr/selection.parquet``, in the order of the rounds."""
    affine: NDArray[np.float64] | None = None  # [3, 4]
    """The colours of the last scene to those of the frame; None without compensation."""
    formation: Mapping[str, Any] = field(default_factory=dict)
    """Column of the last scene's ``formation.parquet`` -> value; empty without one."""

    @property
    def role(self) -> str:
        """RVA's, or one of the two above; "" where it is unknown."""
        if not self.frame.registered:
            return UNPLACED
        return HELD_OUT if self.frame.split != "train" else str(self.judged.get("role", ""))

    @property
    def weight(self) -> float | None:
        """Weight of its raw supervision, 0 to 1."""
        return self.judged.get("weight")

    @property
    def selection(self) -> Selection | None:
        """Its row of the latest round."""
        return self.rounds[-1] if self.rounds else None

    @property
    def chosen(self) -> str | None:
        """The layer of the latest round that supervises the frame."""
        if self.selection is None:
            return None
        kept = self.selection.accepted or self.selection.chosen == "observed"
        return self.selection.chosen if kept else None

    @property
    def gain_ev(self) -> float | None:
        """Exposure next to the scene's at middle grey, stops; None without compensation."""
        if self.affine is None:
            return None
        grey = self.affine[:, :3].sum(axis=1) * 0.5 + self.affine[:, 3]
        # sRGB to linear light near middle grey is a power of 2.4 or so; a stop is a factor of two there.
        return 2.4 * math.log2(max(float(grey.mean()), 1e-3) / 0.5)

    def motion(self, name: Literal["blur_px", "skew_px"]) -> float | None:
        """The way of the pixels while exposed, or of the last line of pixels against the first."""
        found: float | None = self.formation.get(name, getattr(self.selection, name, None))
        return found


def scores_of(selection: Selection) -> list[tuple[str, dict[str, float]]]:
    """Name of the scorer, and candidate -> score: of the one that decides, then of that for ties."""
    found = []
    for use in ("primary", "tiebreak"):
        scores = {name: getattr(selection, f"{use}_{name}") for name in CHOICES}
        known = {name: score for name, score in scores.items() if score is not None}
        found.append((getattr(selection, f"{use}_metric"), known))
    return found


SCENES = ("g0", "rivr", "consolidate")
"""The stages that make a scene, in order."""


def last_scene(stages: Collection[str]) -> str | None:
    """The last of ``stages`` that makes a scene; None without one."""
    return next((stage for stage in reversed(SCENES) if stage in stages), None)


def load_rows(run: Path, stages: Collection[str]) -> list[FrameRow]:
    """The frames of ``run`` in their order, as far as ``stages`` say something of them. Raises StoreError."""
    judged: dict[int, dict[str, Any]] = {}
    if "rva" in stages:
        rows = read_table(run / "rva" / "frames.parquet", FRAMES).to_pylist()
        judged = {row["frame_id"]: row for row in rows}
    rounds: dict[int, list[Selection]] = {}
    if "rivr" in stages:
        for found in sorted(read_selection(run / "rivr" / "selection.parquet"), key=lambda row: row.round):
            rounds.setdefault(found.frame_id, []).append(found)
    affines: dict[int, NDArray[np.float64]] = {}
    formation: dict[int, dict[str, Any]] = {}  # a scene may be trained without asking what the camera did
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
    """The camera of a registered frame."""
    return view_of(frame, Path(), 0.0).camera


# -- pictures ------------------------------------------------------------------------------------------------


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

_BYTES_PER_PIXEL, _SIDE_MAX, _SIDE_MIN = 0.18, 960, 240  # of JPEGs at _QUALITY; px, long side
_THUMBNAIL, _QUALITY = 240, 84

RENDERED = 40
"""Most frames at which the final scene is rendered, evenly along the trajectory: more would take too long."""


class ImageFile(NamedTuple):
    """A picture of the report, with the size it has."""

    path: str
    """Relative to the report."""
    width: int
    height: int


FramePictures = tuple[ImageFile, dict[str, ImageFile]]
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
    pixels = budget / (_BYTES_PER_PIXEL * max(pictures, 1))
    return int(np.clip(math.sqrt(pixels / min(aspect, 1 / aspect)), least, _SIDE_MAX))


def layers_of(row: FrameRow, run: Path) -> dict[str, ImageU8]:
    """The frame as filmed, and the other layers of its latest round. Raises InputError, StoreError."""
    images = {"observed": read_rgb(run / "ingest" / row.frame.image)}
    if row.selection is not None:
        stored = read_exr(run / "rivr" / row.selection.exr).layers
        images |= {name: to_uint8(from_layer(layer)) for name, layer in stored.items() if name != "observed"}
    return images


def _write_frame(row: FrameRow, run: Path, report: Path, final: ImageU8 | None, side: int) -> FramePictures:
    images = layers_of(row, run)
    if final is not None:
        images["final"] = final
    name = f"{FOLDER}/{row.frame.frame_id:06d}"
    names = [layer for layer in LAYERS if layer in images]
    layers = {layer: write_jpeg(report, f"{name}-{layer}.jpg", images[layer], side) for layer in names}
    return write_jpeg(report, f"{name}.jpg", images["observed"], _THUMBNAIL), layers


def write_jpeg(report: Path, name: str, image: ImageU8, side: int) -> ImageFile:
    """Write ``image`` reduced to at most ``side`` pixels."""
    height, width = image.shape[:2]
    factor = min(1.0, side / max(height, width))
    if factor < 1.0:
        width, height = max(1, round(width * factor)), max(1, round(height * factor))
        image = np.asarray(cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA), np.uint8)
    bgr = cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
    _, data = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY, cv2.IMWRITE_JPEG_OPTIMIZE, 1])
    (report / name).write_bytes(data.tobytes())
    return ImageFile(name, width, height)
