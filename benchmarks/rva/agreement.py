"""Rank agreement of two evaluators of frames: R (reliability), B (risk of degradation) and each cue."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.stats import rankdata

from cleargs.rva.allocation import appearance_scores, is_reliable
from cleargs.rva.config import AssessmentConfig
from cleargs.rva.tables import CUE_COLUMNS
from cleargs.types import ArrayF64


@dataclass(frozen=True)
class EvaluatorCues:
    """Cues of one evaluator for n frames."""

    evaluator: str
    """Label in the tables."""
    cues: ArrayF64  # [n, 11] in [0, 1]; NaN for frames without a score


@dataclass(frozen=True)
class Disagreement:
    """A frame on which two evaluators disagree; pairs are (first, second evaluator)."""

    row: int
    gap: float
    """Difference of the ranks by R - B, in [0, 1]; 1 if the frame is best for one and worst for the other."""
    R: tuple[float, float]
    B: tuple[float, float]
    rank: tuple[int, int]
    """Rank by R - B; 1 is best, and equal frames share the lowest rank."""


@dataclass(frozen=True)
class RankAgreement:
    """Agreement of two evaluators over the frames that both scored."""

    evaluators: tuple[str, str]
    frames: int
    spearman: dict[str, float | None]
    """R, B, R-B and each cue -> rank correlation; None for constant values and for fewer than two frames."""
    reliable: dict[str, int]
    """Number of frames that both, only the first, only the second and neither put into the reliable set A."""
    disagreements: tuple[Disagreement, ...]
    """In order of decreasing gap; the earlier frame comes first in a tie."""

    def document(self, frame_id: list[int], names: list[str]) -> dict[str, Any]:
        """Return JSON values; ``frame_id`` and ``names`` describe the rows."""
        return {
            "evaluators": list(self.evaluators),
            "frames": self.frames,
            "spearman": self.spearman,
            "reliable": self.reliable,
            "disagreements": [
                {
                    "frame_id": frame_id[d.row],
                    "name": names[d.row],
                    "gap": round(d.gap, 6),
                    "R": [round(value, 6) for value in d.R],
                    "B": [round(value, 6) for value in d.B],
                    "rank": list(d.rank),
                }
                for d in self.disagreements
            ],
        }


def compare(
    first: EvaluatorCues, second: EvaluatorCues, config: AssessmentConfig, *, most: int
) -> RankAgreement:
    """Compare two evaluators over the frames that both scored.

    Args:
        first: Cues of one evaluator.
        second: Cues of the other evaluator, for the same frames.
        config: Weights and thresholds that turn cues into R, B and the reliable set.
        most: Maximum number of disagreements to return, the widest gaps first.
    """
    rows = np.flatnonzero(~np.isnan(first.cues).any(axis=1) & ~np.isnan(second.cues).any(axis=1))
    sides = []
    for given in (first, second):
        cues = given.cues[rows]
        R, B = appearance_scores(cues, config)
        sides.append(np.column_stack([R, B, R - B, cues]))
    a, b = sides
    columns = ("R", "B", "R-B", *CUE_COLUMNS)
    in_a, in_b = (is_reliable(side[:, 0], side[:, 1], config) for side in sides)
    return RankAgreement(
        evaluators=(first.evaluator, second.evaluator),
        frames=len(rows),
        spearman={name: spearman(a[:, k], b[:, k]) for k, name in enumerate(columns)},
        reliable={
            "both": int(np.count_nonzero(in_a & in_b)),
            "first_only": int(np.count_nonzero(in_a & ~in_b)),
            "second_only": int(np.count_nonzero(~in_a & in_b)),
            "neither": int(np.count_nonzero(~in_a & ~in_b)),
        },
        disagreements=_disagreements(rows, a, b, most),
    )


def spearman(x: ArrayF64, y: ArrayF64) -> float | None:  # [n] each
    """Return Spearman's rank correlation in [-1, 1], with mean ranks for ties; None if it is undefined."""
    if len(x) < 2 or np.ptp(x) == 0.0 or np.ptp(y) == 0.0:
        return None
    correlation = float(np.corrcoef(rankdata(x), rankdata(y))[0, 1])
    return round(min(1.0, max(-1.0, correlation)), 6)


def _disagreements(
    rows: npt.NDArray[np.intp],  # [m] rows of the capture
    a: ArrayF64,  # [m, 3+] R, B, R - B
    b: ArrayF64,  # [m, 3+]
    most: int,
) -> tuple[Disagreement, ...]:
    means = [rankdata(-side[:, 2]) for side in (a, b)]
    places = [rankdata(-side[:, 2], method="min") for side in (a, b)]
    gaps = np.abs(means[0] - means[1]) / max(1, len(rows) - 1)
    widest = [k for k in np.argsort(-gaps, kind="stable")[:most] if gaps[k] > 0.0]
    return tuple(
        Disagreement(
            row=int(rows[k]),
            gap=float(gaps[k]),
            R=(float(a[k, 0]), float(b[k, 0])),
            B=(float(a[k, 1]), float(b[k, 1])),
            rank=(int(places[0][k]), int(places[1][k])),
        )
        for k in widest
    )
