"""The formation of one frame as a training keeps it: its motion, how well it fits, and its row in tables."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cleargs.formation.comparison import explained_share
from cleargs.formation.motion import MODELS, TWISTS, FrameMotion, Model
from cleargs.formation.search import named
from cleargs.splat.camera import Camera
from cleargs.splat.kernels.warp_layout import BEND_REACH, CUBE_REACH, DisplacementFields

MARGIN_STEP = 4
"""Margins are multiples of this, px."""
MARGIN_SHARE = 0.25
"""Largest margin, as a share of the shorter side."""

LENS = ("disc_px", "focus", "median_depth", "exposure_s")
MEASURED = ("residual", "residual_without", "blur_px", "skew_px", "defocus_px", "displacement_px")
"""Fields of a frame's motion in addition to its twists, and of the frame, in checkpoints and tables."""
AXES = ("tx", "ty", "tz", "rx", "ry", "rz")


@dataclass(frozen=True)
class FrameFormation:
    """The current estimate of a frame's formation. Lengths are in pixels of the full image."""

    frame_id: int
    motion: FrameMotion = field(default_factory=FrameMotion)
    model: Model = "none"
    residual: float = 0.0
    """Mean difference of high-passed linear luminance that the model leaves, see `comparison.MotionFit`."""
    residual_without: float = 0.0
    blur_px: float = 0.0
    """Mean length of the pixels' paths during the exposure."""
    skew_px: float = 0.0
    """Mean length of the pixels' paths from the first to the last row's exposure."""
    defocus_px: float = 0.0
    """Mean radius of the discs of defocus."""
    displacement_px: float = 0.0
    """Largest displacement of a pixel's samples along an axis: the 95th percentile over the pixels."""
    skew_gain: float | None = None
    """Share of the residual that a rolling shutter explains beyond blur and defocus, by the last search that
    tried one; None if none did."""
    blur_gain: float = 0.0
    """Least gain of a further blur (`pretest`) since the last search."""
    steps: int = 0
    """Training steps on the frame since the first estimate of its formation."""

    @property
    def searched(self) -> bool:
        """True if a search found the blur or the defocus of the frame."""
        return self.model in ("blur", "both", "defocus") and self.motion.exposure_s == 0.0

    @property
    def explained(self) -> float:
        """Share of the residual that the model removes."""
        return explained_share(self.residual, self.residual_without)


def filmed_as(motion: FrameMotion, frame_id: int = -1) -> FrameFormation:
    """Return the formation of a frame with a measured ``motion``."""
    # No pixel moves farther than at the first and at the last row, and at the ends of the exposure.
    displacement = 0.5 * float(np.abs(motion.skew).sum() + np.abs(motion.blur).sum())
    model = named("blur" if motion.blur.any() else "none", motion)
    return FrameFormation(frame_id, motion, model, displacement_px=displacement)


def described(frame: FrameFormation) -> str:
    """Return the formation in a few words: ``blur 5.2 px, skew 1.4 px``."""
    lengths = {"blur": frame.blur_px, "skew": frame.skew_px, "defocus": frame.defocus_px}
    parts = ("blur", "skew") if frame.model == "both" else (frame.model,)
    return ", ".join(f"{part} {lengths[part]:.1f} px" for part in parts if part in lengths) or "nothing"


def displacement_of(fields: DisplacementFields) -> float:
    """Return the displacement of the pixels, px: see `FrameFormation.displacement_px`."""
    few = (..., slice(None, None, 4), slice(None, None, 4))
    displacements = fields.offset[few].abs() + 0.5 * fields.sweep[few].abs() + fields.radius[few]
    if fields.curve is not None:
        curve = fields.curve[few].abs()
        displacements += BEND_REACH * curve[:2] + CUBE_REACH * curve[2:]
    return float(np.quantile(displacements.amax(dim=0).cpu().numpy(), 0.95))


def margin_for(displacement: float, camera: Camera) -> int:
    """Return the margin, px, that contains the pixels that moved in from outside the border."""
    largest = int(MARGIN_SHARE * min(camera.width, camera.height)) // MARGIN_STEP * MARGIN_STEP
    return min(largest, MARGIN_STEP * math.ceil(displacement / MARGIN_STEP)) if displacement >= 0.5 else 0


def as_row(frame: FrameFormation) -> dict[str, Any]:
    """Return the numbers of the frame by their names in ``formation.parquet``."""
    motion = frame.motion
    row: dict[str, Any] = {name: getattr(frame, name) for name in ("frame_id", "model", "steps", "blur_gain")}
    for name in TWISTS:
        row |= {f"{name}_{axis}": float(v) for axis, v in zip(AXES, getattr(motion, name), strict=True)}
    row |= {name: getattr(motion, name) for name in (*LENS, "columns")} | {"order": motion.order}
    return row | {name: getattr(frame, name) for name in (*MEASURED, "skew_gain")}


def from_row(row: Mapping[str, Any]) -> FrameFormation:
    """Return the frame of a row from `as_row`."""
    vector = np.array([row[f"{name}_{axis}"] for name in TWISTS for axis in AXES])
    motion = FrameMotion(**{name: row[name] for name in LENS}, columns=bool(row["columns"]))
    own = {name: row[name] for name in ("model", "steps", "blur_gain", *MEASURED, "skew_gain")}
    return FrameFormation(row["frame_id"], motion.with_vector(vector), **own)


def packed(frames: Iterable[FrameFormation]) -> NDArray[np.float64]:
    """Return the frames as one row of numbers each, for a checkpoint."""
    rows = []
    for frame in frames:
        gain = -1.0 if frame.skew_gain is None else frame.skew_gain
        row = as_row(frame) | {"model": MODELS.index(frame.model), "skew_gain": gain}
        rows.append(list(row.values()))
    return np.array(rows, np.float64).reshape(len(rows), len(as_row(FrameFormation(0))))


def unpacked(numbers: NDArray[np.float64]) -> Iterator[FrameFormation]:
    """Yield the frames in the result of `packed`."""
    names = tuple(as_row(FrameFormation(0)))
    for row in (dict(zip(names, values, strict=True)) for values in numbers.tolist()):
        gain = None if row["skew_gain"] < 0.0 else row["skew_gain"]
        counts = {name: int(row[name]) for name in ("frame_id", "steps")}
        yield from_row(row | counts | {"model": MODELS[int(row["model"])], "skew_gain": gain})
