"""Relocation, growth and noise during a training, on the device where its Gaussians lie.

The rules are those of ``strategy`` on every device; a GPU draws other random numbers than the CPU.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from cleargs.splat import strategy
from cleargs.splat.config import TrainConfig
from cleargs.splat.gaussians import Gaussians
from cleargs.splat.kernels.cuda import support
from cleargs.splat.optimiser import Moments

_REFINE, _NOISE = 2, 3
"""Purposes of random numbers; 0 and 1 choose views."""


class Densifier:
    """Densification as ``config`` asks for, up to ``budget`` Gaussians. Steps count from 1."""

    def __init__(self, config: TrainConfig, budget: int, seed: Sequence[int]) -> None:
        self._config = config
        self._budget = budget
        self._seed = tuple(seed)

    def due(self, step: int) -> bool:
        """Whether Gaussians are relocated and added after this step."""
        config = self._config
        return (
            step % config.refine_interval == 0
            and config.refine_start * config.steps <= step <= config.refine_stop * config.steps
        )

    def refine(self, gaussians: Gaussians, moments: Moments, step: int) -> tuple[Gaussians, Moments]:
        """Relocate the dead and grow. What is given is changed and must not be used again."""
        config = self._config
        if support.on_gpu(gaussians.device):
            from cleargs.splat.kernels.cuda import densify

            on_device = [moments.first, moments.second]
            seeds = [densify.seed_of(*self._seed, _REFINE, step, part) for part in (0, 1)]
            densify.relocate(gaussians, on_device, min_opacity=config.min_opacity, seed=seeds[0])
            gaussians, on_device = densify.grow(
                gaussians,
                on_device,
                rate=config.growth,
                budget=self._budget,
                min_opacity=config.min_opacity,
                seed=seeds[1],
            )
            return gaussians, Moments(*on_device)
        rng = self._rng(_REFINE, step)
        arrays = {name: tensor.numpy() for name, tensor in gaussians.tensors().items()}
        running = [
            {name: tensor.numpy() for name, tensor in group.items()}
            for group in (moments.first, moments.second)
        ]
        strategy.relocate(arrays, running, min_opacity=config.min_opacity, rng=rng)
        arrays, running = strategy.grow(
            arrays,
            running,
            rate=config.growth,
            budget=self._budget,
            min_opacity=config.min_opacity,
            rng=rng,
        )
        grown, first, second = (
            {name: torch.from_numpy(array) for name, array in group.items()} for group in (arrays, *running)
        )
        return Gaussians(**grown), Moments(first, second)

    def shake(self, gaussians: Gaussians, rate: float, step: int) -> None:
        """Add the noise of a step to the means, in place; ``rate`` is their learning rate."""
        config = self._config
        if config.noise == 0.0:
            return
        amount = config.noise * rate
        if support.on_gpu(gaussians.device):
            from cleargs.splat.kernels.cuda import densify

            seed = densify.seed_of(*self._seed, _NOISE, step)
            densify.shake(gaussians, amount=amount, min_opacity=config.min_opacity, seed=seed)
            return
        felt, offsets = strategy.mean_noise(
            gaussians.log_scales.numpy(),
            gaussians.rotations.numpy(),
            gaussians.logit_opacities.numpy(),
            amount=amount,
            min_opacity=config.min_opacity,
            rng=self._rng(_NOISE, step),
        )
        gaussians.means.numpy()[felt] += offsets

    def _rng(self, purpose: int, step: int) -> np.random.Generator:
        return np.random.default_rng([*self._seed, purpose, step])
