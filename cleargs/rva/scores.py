"""From cues to scores: reliability R, degradation risk B, the reliable set A (paper, Appearance Evidence)."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from cleargs.rva.config import RvaConfig
from cleargs.rva.tables import R_CUES

Floats = npt.NDArray[np.float64]
Bools = npt.NDArray[np.bool_]


def appearance_scores(
    cues: Floats,  # [N, 11] in [0, 1], columns as tables.CUE_COLUMNS
    config: RvaConfig,
) -> tuple[Floats, Floats]:  # R [N], B [N], both in [0, 1]
    """R = w_R . r and B = w_B . b. The sums run cue by cue, so that a row's score needs that row alone."""
    r, b = cues[:, : len(R_CUES)], cues[:, len(R_CUES) :]
    R = sum((w * r[:, k] for k, w in enumerate(config.w_R)), start=np.zeros(len(cues)))
    B = sum((w * b[:, k] for k, w in enumerate(config.w_B)), start=np.zeros(len(cues)))
    # The weights sum to 1 up to rounding: keep a perfect frame at 1 exactly.
    return np.clip(R, 0.0, 1.0), np.clip(B, 0.0, 1.0)


def is_reliable(R: Floats, B: Floats, config: RvaConfig) -> Bools:
    """Membership in the appearance-reliable set A = {R >= tau_R, B <= tau_B}."""
    return np.asarray((config.tau_R <= R) & (config.tau_B >= B))


def stand_in_set(R: Floats, B: Floats, config: RvaConfig) -> Bools:
    """The best frames by R - B, a share `stand_in_share` of them and at least one (none of none).

    They take the place of an empty set A in the geometry. Rows are in trajectory order: ties go to the
    earlier.
    """
    chosen = np.zeros(len(R), dtype=bool)
    if len(R):
        count = max(1, round(config.stand_in_share * len(R)))
        chosen[np.argsort(B - R, kind="stable")[:count]] = True
    return chosen
