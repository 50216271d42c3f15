"""Roles, coverage compensation and weights (paper, Supervision assignment and Trajectory Coverage
Compensation).
"""

from __future__ import annotations

import math
from enum import StrEnum

import numpy as np
import numpy.typing as npt

from cleargs.rva.config import RvaConfig
from cleargs.rva.scores import Bools, Floats, is_reliable

Roles = npt.NDArray[np.str_]


class Role(StrEnum):
    """How much a frame's raw pixels supervise the scene, from most to least."""

    STRONG = "strong"
    GEOMETRIC = "geometric"
    AUXILIARY = "auxiliary"
    REACTIVATED = "reactivated"
    SUPPRESSED = "suppressed"


def standard_roles(R: Floats, B: Floats, G: Floats, config: RvaConfig) -> Roles:  # [N] each
    """The standard supervision conditions, evaluated from top to bottom; suppressed where none holds."""
    geometric = (config.geometric_G <= G) & (config.geometric_B >= B)
    auxiliary = (config.auxiliary_R <= R) & (config.auxiliary_G <= G) & (config.auxiliary_B >= B)
    return np.select(
        [is_reliable(R, B, config), geometric, auxiliary],
        [Role.STRONG.value, Role.GEOMETRIC.value, Role.AUXILIARY.value],
        default=Role.SUPPRESSED.value,
    )


def uncovered_bins(roles: Roles, bins: npt.NDArray[np.int32]) -> npt.NDArray[np.int32]:
    """Bins that hold suppressed frames only (an empty bin has nothing to reactivate)."""
    return np.setdiff1d(bins, bins[roles != Role.SUPPRESSED])


def reactivation_gain(R: Floats, B: Floats, G: Floats, Z: Floats, config: RvaConfig) -> Floats:
    """lambda_G G + lambda_R R + lambda_B (1 - B) + lambda_Z Z (paper, eq. tca_selection)."""
    quality = config.lambda_R * R + config.lambda_B * (1.0 - B)
    return np.asarray(config.lambda_G * G + quality + config.lambda_Z * Z)


def reactivate(
    roles: Roles,  # [N] standard roles, in trajectory order
    bins: npt.NDArray[np.int32],  # [N]
    gain: Floats,  # [N] from `reactivation_gain`
) -> Bools:  # [N]
    """The frame i*_m of every uncovered bin: the one of largest gain; ties go to the earlier frame."""
    chosen = np.zeros(len(roles), dtype=bool)
    for index in uncovered_bins(roles, bins):
        members = np.flatnonzero(bins == index)
        chosen[members[np.argmax(gain[members])]] = True
    return chosen


def supervision_weights(roles: Roles, R: Floats, G: Floats, config: RvaConfig) -> Floats:  # w [N] in [0, 1]
    """The weight that the table gives to each role."""

    def attenuated(mix: tuple[float, float]) -> Floats:
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
    return np.asarray(np.clip(weight, 0.0, 1.0))  # base + gain may pass 1 by rounding


def keep_sharp(R: Floats, B: Floats, share: float, config: RvaConfig) -> tuple[Roles, Floats]:  # [N] each
    """Roles and weights of the baseline that drops blurry frames.

    ``share`` of the frames (rounded up, so at least one), best by R - B, and every reliable frame beyond it
    get weight 1, the others 0. Ties go to the earlier frame.
    """
    reliable = is_reliable(R, B, config)
    kept = reliable.copy()
    kept[np.argsort(B - R, kind="stable")[: math.ceil(share * len(R))]] = True
    roles = np.select(
        [reliable, kept], [Role.STRONG.value, Role.AUXILIARY.value], default=Role.SUPPRESSED.value
    )
    return roles, kept.astype(np.float64)


def effective_sample_size(weight: Floats) -> float:
    """Kish's (sum w)^2 / sum w^2: how many equally weighted frames the weights are worth; 0 for none."""
    squares = float(np.dot(weight, weight))
    return float(weight.sum()) ** 2 / squares if squares > 0.0 else 0.0
