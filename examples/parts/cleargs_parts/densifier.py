"""A densification strategy: g0.densify=prune removes transparent Gaussians, and adds none."""

import numpy as np
from numpy.typing import NDArray

from cleargs.splat.config import TrainConfig
from cleargs.splat.densifier import DensifierState
from cleargs.splat.gaussians import Gaussians
from cleargs.splat.types import Moments


class Prune:
    """Created for each training, with its settings."""

    def __init__(self, config: TrainConfig) -> None:
        self.config = config

    def wants_errors(self, step: int) -> bool:
        return False

    def after_step(self, state: DensifierState) -> None:
        if state.step % self.config.refine_interval:
            return
        kept = state.gaussians.logit_opacities.sigmoid() > self.config.min_opacity
        if bool(kept.any()):
            rows = [
                {name: tensor[kept].contiguous() for name, tensor in tensors.items()}
                for tensors in (state.gaussians.tensors(), state.moments.first, state.moments.second)
            ]
            state.gaussians, state.moments = Gaussians(**rows[0]), Moments(*rows[1:])

    def expected_counts(self, start: int) -> NDArray[np.float64]:
        return np.full(self.config.length, float(start))
