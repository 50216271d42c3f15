"""Rank correlation of an evaluator's cues with the known degradations of a synthetic capture."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from benchmarks.rva.agreement import spearman
from cleargs.types import ArrayBool, ArrayF64

MIN_BLUR_PX = 1.0
"""Shorter blur, in px, counts as zero, so that such frames share one rank."""
MIN_EXPOSURE_ERROR_EV = 0.25
"""Smaller exposure errors, in stops, count as zero: automatic exposure drifts by as much."""
MIN_DEFOCUS_PX = 0.1
"""Smaller discs of defocus, in px, count as zero."""


@dataclass(frozen=True)
class Faults:
    """True degradations of n frames: the columns of ``truth/frames.parquet`` with the same names."""

    blur_px: ArrayF64
    defocus_px: ArrayF64
    exposure_ev: ArrayF64

    def noticeable(self) -> Faults:
        """Return a copy with 0 for values below the limits, and exposure errors without sign."""
        stops = np.abs(self.exposure_ev)
        return Faults(
            np.where(self.blur_px < MIN_BLUR_PX, 0.0, self.blur_px),
            np.where(self.defocus_px < MIN_DEFOCUS_PX, 0.0, self.defocus_px),
            np.where(stops < MIN_EXPOSURE_ERROR_EV, 0.0, stops),
        )


@dataclass(frozen=True)
class Check:
    """Rank correlations of one capture; None if the cue or the truth is constant."""

    frames: int
    strong: float
    """Share of the frames that are in the reliable set A."""
    B_blur: float | None
    """B and the blur length, over the frames without another degradation."""
    R_blur: float | None
    """-R and the blur length, over the same frames."""
    motion: float | None
    """b_motion_blur and the blur length, over all frames."""
    defocus: float | None
    exposure: float | None


def check(
    R: ArrayF64,  # [n]
    B: ArrayF64,  # [n]
    cues: dict[str, ArrayF64],  # b_motion_blur, b_defocus, b_exposure_failure -> [n]
    reliable: ArrayBool,  # [n]
    faults: Faults,
) -> Check:
    """Return Spearman's rank correlations of scores and cues with the true degradations."""
    true = faults.noticeable()
    alone = (true.defocus_px == 0.0) & (true.exposure_ev == 0.0)
    return Check(
        frames=len(R),
        strong=float(np.mean(reliable)),
        B_blur=spearman(B[alone], true.blur_px[alone]),
        R_blur=spearman(-R[alone], true.blur_px[alone]),
        motion=spearman(cues["b_motion_blur"], true.blur_px),
        defocus=spearman(cues["b_defocus"], true.defocus_px),
        exposure=spearman(cues["b_exposure_failure"], true.exposure_ev),
    )
