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
from cleargs.evaluate.metrics import apply_affine, fit_affine
from cleargs.evaluate.metrics import psnr as psnr_of
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
from cleargs.rva.tables import B_CUES, FRAMES, R_CUES
from cleargs.splat.camera import Camera
from cleargs.splat.render import Viewer
from cleargs.splat.tables import TRAIN
from cleargs.types import ImageU8, MaskBool

HELD_OUT, UNPLACED = "held out", "not placed"
"""Roles, on the page, of frames that RVA does not rate."""

CHOICES = {
    "render": "the render",
    "restored": "the restored frame",
    "fused": "the fusion of render and restored frame",
    "observed": "kept as filmed",
}
"""Candidate -> its description in the report."""

EFFECTS = {
    "blur": ("motion blur", "blur_px"),
    "skew": ("rolling shutter", "skew_px"),
    "both": ("motion blur and rolling shutter", "blur_px"),
    "defocus": ("defocus", "defocus_px"),
}
"""Model of image formation -> its name, and the column of ``formation.parquet`` with its size."""

MIN_FAULT = 0.2
"""Smaller faults of a frame are not reported."""

LAST_STEPS = 3
"""Number of the last training steps on a frame whose PSNR is shown as that of the frame."""

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
    psnr: float | None = None
    """Median PSNR, dB, of the last training steps on the raw frame, as its camera saw it; None if no training
    used the frame."""
    moving: MaskBool | None = None  # [rows, columns]
    """Cells, which divide the frame evenly, that the training left out since something moves there."""

    @property
    def role(self) -> str:
        """Role by RVA, `HELD_OUT` or `UNPLACED`; "" if it is unknown."""
        if not self.frame.registered:
            return UNPLACED
        return HELD_OUT if self.frame.split != "train" else str(self.judged.get("role", ""))

    @property
    def weight(self) -> float | None:
        """Weight with which the raw frame taught at the end, from 0 to 1; None if it is unknown."""
        weight: float | None = self.formation.get("weight_after", self.judged.get("weight"))
        return weight

    @property
    def teaching(self) -> str:
        """The weight of the raw frame in words, with its reason; "" if it is unknown."""
        if self.role in (UNPLACED, HELD_OUT):
            return f"{self.role}: not used"
        if self.weight is None:
            return ""
        counts = "counts fully" if self.weight > 0.995 else f"counts {100 * self.weight:.0f} %"
        counts = counts if self.weight else "not used"
        if self.modelled:
            effect, size = EFFECTS[self.formation["model"]]
            return f"{effect} {self.formation[size]:.1f} px, simulated: {counts}"
        fault = worst_cue(self.judged)
        return f"{fault}: {counts}" if fault and self.weight < 0.995 else counts

    @property
    def selection(self) -> Selection | None:
        """Row of the latest round."""
        return self.rounds[-1] if self.rounds else None

    @property
    def chosen(self) -> str | None:
        """Candidate of the latest round that repairs the frame; None if the frame is kept as filmed."""
        return self.selection.chosen if self.selection is not None and self.selection.accepted else None

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


def worst_cue(judged: Mapping[str, Any]) -> str:
    """Return the largest fault of a row of ``rva/frames.parquet``, from 0 (good) to 1, as "blur 0.82".

    A low quality counts as a fault too, as "low sharpness 0.94". "" if no fault reaches `MIN_FAULT`.
    """
    faults = faults_of(judged)
    name = max(faults, key=lambda name: faults[name], default="")
    return f"{name} {faults[name]:.2f}" if name and faults[name] >= MIN_FAULT else ""


def faults_of(judged: Mapping[str, Any]) -> dict[str, float]:
    """Return the cues of a row of ``rva/frames.parquet`` as faults, from 0 (good) to 1 (bad)."""
    lacking = {f"low {name}": judged.get(f"r_{name}") for name in R_CUES}
    harms = {name.replace("_", " "): judged.get(f"b_{name}") for name in B_CUES}
    faults = {name: 1.0 - value for name, value in lacking.items() if value is not None}
    return faults | {name: value for name, value in harms.items() if value is not None}


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
    psnr = _last_psnr([run / stage / "train.parquet" for stage in SCENES if stage in stages])
    affines: dict[int, NDArray[np.float64]] = {}
    formation: dict[int, dict[str, Any]] = {}  # stays empty if image formation is off
    moving: dict[int, MaskBool] = {}
    if final := last_scene(stages):
        if (path := run / final / "movement.parquet").is_file():
            for row in read_any_table(path).to_pylist():
                shape = row["rows"], row["columns"]
                bits = np.unpackbits(np.frombuffer(row["moves"], np.uint8), count=shape[0] * shape[1])
                moving[row["frame_id"]] = bits.reshape(shape) > 0
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
            psnr.get(frame.frame_id),
            moving.get(frame.frame_id),
        )
        for frame in load_frames(run / "ingest")
    ]


def _last_psnr(tables: Sequence[Path]) -> dict[int, float]:
    """Return frame_id -> median PSNR of the last `LAST_STEPS` steps on the raw frame at its full size."""
    steps: dict[int, list[tuple[int, float]]] = {}
    for table in (read_table(path, TRAIN) for path in tables if path.is_file()):
        columns = (table[name].to_pylist() for name in ("frame_id", "kind", "width", "psnr"))
        for frame_id, kind, width, psnr in zip(*columns, strict=True):
            if kind == "real" and math.isfinite(psnr):
                steps.setdefault(frame_id, []).append((width, psnr))
    found = {}
    for frame_id, of_frame in steps.items():
        full = max(width for width, _ in of_frame)
        found[frame_id] = float(np.median([psnr for width, psnr in of_frame if width == full][-LAST_STEPS:]))
    return found


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
_DARK, _LIGHT = (20, 20, 20), (255, 210, 60)  # of a drawn path and its border
_UNUSED = (214, 69, 48)  # colour of pixels that no training used, sRGB

MAX_RENDERED = 40
"""Maximum number of frames, evenly along the trajectory, for which the final scene is rendered. It limits the
time."""


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
    if row.moving is not None:
        height, width = images["observed"].shape[:2]
        cells = cv2.resize(row.moving.astype(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST)
        tint = np.where(cells[..., None] > 0, _UNUSED, images["observed"]).astype(np.uint8)
        images["moving"] = np.asarray(cv2.addWeighted(images["observed"], 0.4, tint, 0.6, 0.0), np.uint8)
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
    unseen = _aligned_psnr(final, images["observed"]) if final is not None and row.role == HELD_OUT else None
    return FramePictures(write_jpeg(report, f"{name}.jpg", images["observed"], _THUMBNAIL), layers, unseen)


def _aligned_psnr(render: ImageU8, observed: ImageU8) -> float | None:
    """Return the PSNR, dB, of a render against the raw frame, after the best affine change of its colours."""
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
