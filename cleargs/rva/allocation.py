"""Scores, roles and weights of frames from their appearance cues; frames are always in trajectory order.

Implements the paper's Appearance Evidence (reliability R, degradation risk B, reliable set A), Supervision
Assignment and Trajectory Coverage Compensation.
"""

from __future__ import annotations

import math
from enum import StrEnum

import numpy as np
import numpy.typing as npt

from cleargs.rva.config import AssessmentConfig
from cleargs.rva.tables import R_CUES
from cleargs.types import ArrayBool, ArrayF64

Roles = npt.NDArray[np.str_]

_ROUNDING = 1e-9  # 0.55 * 100 = 55.00000000000001 is 55 frames, not 56


class Rule(StrEnum):
    """Reason to reactivate a suppressed frame."""

    COVERAGE = "coverage"
    """The bin had no active frame (the paper's Trajectory Coverage Compensation)."""
    ACTIVE_SHARE = "active_share"
    """The share of active frames in the capture was below `AssessmentConfig.active_share`."""


class Role(StrEnum):
    """Amount of supervision by a frame's raw pixels, from most to least."""

    STRONG = "strong"
    GEOMETRIC = "geometric"
    AUXILIARY = "auxiliary"
    REACTIVATED = "reactivated"
    SUPPRESSED = "suppressed"


def appearance_scores(
    cues: ArrayF64,  # [N, 11] in [0, 1], columns as tables.CUE_COLUMNS
    config: AssessmentConfig,
) -> tuple[ArrayF64, ArrayF64]:  # R [N], B [N], both in [0, 1]
    """Return the reliability R = w_R . r and the degradation risk B = w_B . b of each frame.

    Sums are over one cue at a time, so that the bits of a frame's scores do not depend on the other frames.
    """
    r, b = cues[:, : len(R_CUES)], cues[:, len(R_CUES) :]
    R = sum((w * r[:, k] for k, w in enumerate(config.w_R)), start=np.zeros(len(cues)))
    B = sum((w * b[:, k] for k, w in enumerate(config.w_B)), start=np.zeros(len(cues)))
    # The weights sum to 1 except for rounding. A perfect frame gets exactly 1.
    return np.clip(R, 0.0, 1.0), np.clip(B, 0.0, 1.0)


def is_reliable(R: ArrayF64, B: ArrayF64, config: AssessmentConfig) -> ArrayBool:
    """Return a mask [N] of the appearance-reliable set A = {R >= tau_R, B <= tau_B}."""
    return np.asarray((config.tau_R <= R) & (config.tau_B >= B))


def best_frames(R: ArrayF64, B: ArrayF64, count: int) -> ArrayBool:  # [N] each, in trajectory order
    """Return a mask of the ``count`` frames with the largest R - B; ties go to the earlier frame."""
    chosen = np.zeros(len(R), dtype=bool)
    chosen[np.argsort(B - R, kind="stable")[:count]] = True
    return chosen


def standard_roles(R: ArrayF64, B: ArrayF64, G: ArrayF64, config: AssessmentConfig) -> Roles:  # [N] each
    """Return the first role whose conditions hold (strong, geometric, auxiliary), else suppressed."""
    geometric = (config.geometric_G <= G) & (config.geometric_B >= B)
    auxiliary = (config.auxiliary_R <= R) & (config.auxiliary_G <= G) & (config.auxiliary_B >= B)
    return np.select(
        [is_reliable(R, B, config), geometric, auxiliary],
        [Role.STRONG.value, Role.GEOMETRIC.value, Role.AUXILIARY.value],
        default=Role.SUPPRESSED.value,
    )


def reactivation_gain(
    R: ArrayF64, B: ArrayF64, G: ArrayF64, Z: ArrayF64, config: AssessmentConfig
) -> ArrayF64:
    """Return lambda_G G + lambda_R R + lambda_B (1 - B) + lambda_Z Z [N] (paper, eq. tca_selection)."""
    quality = config.lambda_R * R + config.lambda_B * (1.0 - B)
    return np.asarray(config.lambda_G * G + quality + config.lambda_Z * Z)


def reactivate(
    roles: Roles,  # [N] standard roles, in trajectory order
    bins: npt.NDArray[np.int32],  # [N]
    gain: ArrayF64,  # [N] from `reactivation_gain`
    config: AssessmentConfig,
) -> Roles:  # [N] a `Rule` where a suppressed frame is reactivated, "" elsewhere
    """Choose suppressed frames that supervise after all, with the reason.

    First each bin without an active frame gets its frame of the largest gain, as in the paper. Then the
    frames of largest gain in the whole capture follow, up to ``active_share``. Ties go to the earlier frame.
    """
    rules = np.full(len(roles), "", dtype=f"<U{max(map(len, Rule))}")
    active = roles != Role.SUPPRESSED

    def activate(members: npt.NDArray[np.intp], wanted: int, rule: Rule) -> None:
        suppressed = members[~active[members]]
        missing = max(wanted - int(np.count_nonzero(active[members])), 0)
        best = suppressed[np.argsort(-gain[suppressed], kind="stable")[:missing]]
        rules[best], active[best] = rule.value, True

    for index in np.unique(bins):
        activate(np.flatnonzero(bins == index), 1, Rule.COVERAGE)
    target = math.ceil(config.active_share * len(roles) - _ROUNDING)
    activate(np.arange(len(roles)), target, Rule.ACTIVE_SHARE)
    return rules


def supervision_weights(roles: Roles, R: ArrayF64, G: ArrayF64, config: AssessmentConfig) -> ArrayF64:
    """Return the supervision weight w [N] in [0, 1] of each frame (paper, Supervision Assignment)."""

    def attenuated(mix: tuple[float, float]) -> ArrayF64:
        return config.attenuated_base + config.attenuated_gain * (mix[0] * R + mix[1] * G)

    weight = np.select(
        [roles == role.value for role in Role],
        [
            config.strong_base + config.strong_gain * R,
            attenuated(config.geometric_mix),
            attenuated(config.auxiliary_mix),
            np.full(len(R), config.reactivated_weight),
            np.zeros(len(R)),
        ],
    )
    return np.asarray(np.clip(weight, 0.0, 1.0))  # base + gain may exceed 1 by rounding


def binary_roles(R: ArrayF64, B: ArrayF64, config: AssessmentConfig) -> tuple[Roles, ArrayF64]:  # [N] each
    """Return the roles and weights of the baseline that drops blurry frames.

    The best frames by R - B get weight 1: a share `binary_share` of them (rounded up, at least one) and every
    other reliable frame. The rest gets weight 0.
    """
    reliable = is_reliable(R, B, config)
    count = max(1, math.ceil(config.binary_share * len(R) - _ROUNDING))
    kept = reliable | best_frames(R, B, count)
    roles = np.select(
        [reliable, kept], [Role.STRONG.value, Role.AUXILIARY.value], default=Role.SUPPRESSED.value
    )
    return roles, kept.astype(np.float64)


def effective_sample_size(weight: ArrayF64) -> float:
    """Return Kish's effective sample size (sum w)^2 / sum w^2, in frames. It is 0 if all weights are 0."""
    squares = float(np.dot(weight, weight))
    return float(weight.sum()) ** 2 / squares if squares > 0.0 else 0.0
