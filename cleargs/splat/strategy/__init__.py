"""How the number and the places of Gaussians change during a training: a file a strategy, one protocol."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

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
