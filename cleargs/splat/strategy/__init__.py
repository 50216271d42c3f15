"""How the number and the places of Gaussians change during a training: a file a strategy, one protocol."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from cleargs.plugins import load_part

if TYPE_CHECKING:
    from cleargs.splat.config import TrainConfig
    from cleargs.splat.strategy.base import Strategy


def make_strategy(config: TrainConfig, budget: int, seed: Sequence[int]) -> Strategy:
    """The strategy that ``config.strategy`` names, for at most ``budget`` Gaussians.

    Raises InputError where one of another package cannot be loaded.
    """
    if config.strategy == "mcmc":
        from cleargs.splat.strategy.mcmc import MCMC

        return MCMC(config, budget, seed)
    if config.strategy == "adaptive":
        from cleargs.splat.strategy.adaptive import AdaptiveDensityControl

        return AdaptiveDensityControl(config, budget, seed)
    maker: Callable[[TrainConfig, int, Sequence[int]], Strategy] = load_part("strategies", config.strategy)
    return maker(config, budget, seed)


def budget_from_pixels(pixels: int) -> int:
    """Hard budget of a capture whose active frames hold ``pixels`` pixels in all.

    One Gaussian (59 numbers at SH degree 3) for 160 pixels (480 numbers, most seen by several frames),
    within [40,000, 150,000]: fewer cost a small capture a dB (docs/training.md); with more, an iteration on
    two cores is no longer well under a second.
    """
    return int(np.clip(pixels // 160, 40_000, 150_000))
