"""Whether RIVR chose well: its candidates measured against the sharp truth."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np

from benchmarks.images import read_rgb_float
from cleargs.base_model import FrozenModel
from cleargs.capture.tables import load_frames
from cleargs.media.colour import linear_from_srgb, srgb_from_linear
from cleargs.media.exr import from_layer, read_exr
from cleargs.parquet import read_table
from cleargs.rivr.tables import read_selection
from cleargs.synth.synthetic_capture import FRAMES
from cleargs.types import ImageF32

Distance = Callable[[ImageF32, ImageF32], float]

RAW = "observed"
"""The layer of the raw frame, which a method that keeps frames may choose too."""

_MIN_ERROR = 1e-10
"""Equal images have a PSNR of 100 dB, not an infinite one."""


class ChoiceRow(FrozenModel):
    """The candidates of one row of ``rivr/selection.parquet`` against the truth."""

    round: int
    frame_id: int
    chosen: str
    psnr: dict[str, float]
    """Candidate -> dB; the raw frame is among them."""
    lpips: dict[str, float]
    """Candidate -> LPIPS; empty without its weights."""

    @property
    def best_by_psnr(self) -> bool:
        return self.psnr[self.chosen] == max(self.psnr.values())

    @property
    def best_by_lpips(self) -> bool:
        return bool(self.lpips) and self.lpips[self.chosen] == min(self.lpips.values())

    @property
    def lost_psnr(self) -> float:
        """dB by which the best candidate would have been better."""
        return max(self.psnr.values()) - self.psnr[self.chosen]


class Choices(FrozenModel):
    """All rows of one scene."""

    column: str
    sample: str
    variant: str
    rows: tuple[ChoiceRow, ...]


class ChoiceAgreement(FrozenModel):
    """How well choices agree with the truth.

    Frames that were kept as they were filmed are counted apart: with image formation such a frame is kept
    because its motion is known, not because it would be sharp.
    """

    kept: int
    """Rows whose frame was kept as it was filmed; they count in none of the figures below."""
    repaired: int
    by_psnr: float | None
    """Share of the repaired rows whose chosen candidate is the best by PSNR; None where there is none."""
    by_lpips: float | None
    by_chance: float | None
    """What choosing blindly would reach."""
    lost_psnr: float | None
    """Mean over the repaired rows, dB."""


def agreement(rows: Sequence[ChoiceRow]) -> ChoiceAgreement:
    """The figures of some rows."""
    repaired = [row for row in rows if row.chosen != RAW]

    def mean(values: Iterable[float]) -> float | None:
        return math.fsum(values) / len(repaired) if repaired else None

    return ChoiceAgreement(
        kept=len(rows) - len(repaired),
        repaired=len(repaired),
        by_psnr=mean(row.best_by_psnr for row in repaired),
        by_lpips=mean(row.best_by_lpips for row in repaired) if all(row.lpips for row in repaired) else None,
        by_chance=mean(1 / len(row.psnr) for row in repaired),
        lost_psnr=mean(row.lost_psnr for row in repaired),
    )


def judge_choices(run: Path, capture: Path, lpips: Distance | None) -> list[ChoiceRow]:
    """Every row of a finished RIVR against ``capture/truth/observed``; none where ``capture`` has no truth.

    A candidate has the exposure of its frame, so the truth is given the frame's true exposure error first:
    what is compared is detail, not brightness. Frames that have no truth, or one of another size, are left
    out. Raises StoreError when a table or an EXR is damaged.
    """
    folder, table = capture / "truth" / "observed" / "images", capture / "truth" / "frames.parquet"
    if not folder.is_dir() or not table.is_file():
        return []
    stops = {Path(row["image"]).stem: row["exposure_ev"] for row in read_table(table, FRAMES).to_pylist()}
    stems = {frame.frame_id: Path(frame.name).stem for frame in load_frames(run / "ingest")}
    found = []
    for row in read_selection(run / "rivr" / "selection.parquet"):
        stem = stems[row.frame_id]
        sharp = folder / f"{stem}.png"
        if stem not in stops or not sharp.is_file():
            continue
        truth = exposed(read_rgb_float(sharp), stops[stem])
        candidates = _candidates(run / "rivr" / row.exr, row.chosen)
        if any(image.shape != truth.shape for image in candidates.values()):
            continue
        found.append(
            ChoiceRow(
                round=row.round,
                frame_id=row.frame_id,
                chosen=row.chosen,
                psnr={name: _psnr(image, truth) for name, image in candidates.items()},
                lpips={name: lpips(image, truth) for name, image in candidates.items()} if lpips else {},
            )
        )
    return found


def exposed(image: ImageF32, stops: float) -> ImageF32:
    """An sRGB image as a camera would give it that is off by so many stops."""
    light = linear_from_srgb(image) * np.float32(2.0**stops)
    return np.asarray(srgb_from_linear(np.clip(light, 0.0, 1.0)), np.float32)


def _psnr(image: ImageF32, truth: ImageF32) -> float:
    """PSNR of unrounded images, dB: candidates that look equal in 8 bits still differ."""
    error = float(np.square(image - truth).mean(dtype=np.float64))
    return -10.0 * math.log10(max(error, _MIN_ERROR))


def _candidates(exr: Path, chosen: str) -> Mapping[str, ImageF32]:
    """What could have been chosen, and the raw frame."""
    layers = read_exr(exr).layers
    names = [name for name in ("render", "restored", "fused", RAW) if name in layers]
    return {name: from_layer(layers[name]) for name in dict.fromkeys((*names, chosen))}
