"""Quality of RIVR's choice between repair candidates, measured against the sharp truth."""

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
"""Layer of the frame image. If RIVR chooses it, the frame is not repaired."""

_MIN_ERROR = 1e-10
"""Minimum mean squared error: it limits the PSNR of equal images to 100 dB."""


class ChoiceRow(FrozenModel):
    """Candidates of one row of ``rivr/selection.parquet``, compared with the truth."""

    round: int
    frame_id: int
    chosen: str
    psnr: dict[str, float]
    """Candidate -> PSNR in dB; includes the frame image."""
    lpips: dict[str, float]
    """Candidate -> LPIPS; empty if its weights are not installed."""

    @property
    def best_by_psnr(self) -> bool:
        return self.psnr[self.chosen] == max(self.psnr.values())

    @property
    def best_by_lpips(self) -> bool:
        return bool(self.lpips) and self.lpips[self.chosen] == min(self.lpips.values())

    @property
    def lost_psnr(self) -> float:
        """PSNR of the best candidate minus that of the chosen one, dB."""
        return max(self.psnr.values()) - self.psnr[self.chosen]


class Choices(FrozenModel):
    """All choices of one scene."""

    column: str
    sample: str
    variant: str
    rows: tuple[ChoiceRow, ...]


class ChoiceAgreement(FrozenModel):
    """Agreement of choices with the truth.

    Frames that were kept as filmed are counted separately: with image formation such a frame is kept because
    its motion is known, not because it is sharp.
    """

    kept: int
    """Rows whose frame was kept as filmed; the other figures exclude them."""
    repaired: int
    by_psnr: float | None
    """Share of the repaired rows whose chosen candidate has the best PSNR; None without such rows."""
    by_lpips: float | None
    """The same by LPIPS; None if it is missing for a row."""
    by_chance: float | None
    """Expected share for a random choice."""
    lost_psnr: float | None
    """Mean PSNR loss compared with the best candidate over the repaired rows, dB."""


def agreement(rows: Sequence[ChoiceRow]) -> ChoiceAgreement:
    """Return how often the choices of ``rows`` are the best ones."""
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


def measure_choices(run: Path, capture: Path, lpips: Distance | None) -> list[ChoiceRow]:
    """Measure each candidate of a finished RIVR against ``capture/truth/observed``.

    A candidate has the exposure of its frame. So the frame's true exposure error is applied to the truth
    first: the comparison is about detail, not brightness. Frames without truth, or with truth of another
    size, are left out.

    Args:
        run: Folder of the run.
        capture: Folder of its synthetic capture.
        lpips: LPIPS of two sRGB images; None to measure PSNR only.

    Returns:
        One row per row of ``selection.parquet``; an empty list if the capture has no truth.

    Raises:
        StoreError: A table or an EXR file is damaged.
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
        if row.exr is None or stem not in stops or not sharp.is_file():
            continue
        truth = apply_exposure(read_rgb_float(sharp), stops[stem])
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


def apply_exposure(image: ImageF32, stops: float) -> ImageF32:
    """Change the exposure of an sRGB image [H, W, 3] by ``stops``, in linear light."""
    light = linear_from_srgb(image) * np.float32(2.0**stops)
    return np.asarray(srgb_from_linear(np.clip(light, 0.0, 1.0)), np.float32)


def _psnr(image: ImageF32, truth: ImageF32) -> float:
    """Return the PSNR of float images in dB: candidates that are equal in 8 bits may still differ."""
    error = float(np.square(image - truth).mean(dtype=np.float64))
    return -10.0 * math.log10(max(error, _MIN_ERROR))


def _candidates(exr: Path, chosen: str) -> Mapping[str, ImageF32]:
    """Return the candidates and the frame image, sRGB."""
    layers = read_exr(exr).layers
    names = [name for name in ("render", "restored", "fused", RAW) if name in layers]
    return {name: from_layer(layers[name]) for name in dict.fromkeys((*names, chosen))}
