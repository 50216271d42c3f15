"""A densification strategy: g0.strategy=prune-only adds nothing, and removes what has become faint."""

from collections.abc import Sequence

from cleargs.splat.adam import Moments
from cleargs.splat.config import TrainConfig
from cleargs.splat.gaussians import Gaussians
from cleargs.splat.strategy.base import Strategy


class PruneOnly(Strategy):
    """Made for a training of at most ``budget`` Gaussians."""

    def __init__(self, config: TrainConfig, budget: int, seed: Sequence[int]) -> None:
        self._least = config.min_opacity

    def refine(self, gaussians: Gaussians, moments: Moments, step: int) -> tuple[Gaussians, Moments]:
        keep = gaussians.logit_opacities.sigmoid() > self._least
        if not keep.any():
            return gaussians, moments
        groups = (moments.first, moments.second)
        first, second = ({name: tensor[keep] for name, tensor in group.items()} for group in groups)
        return gaussians.select(keep), Moments(first, second)
