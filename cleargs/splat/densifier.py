"""Densification strategies: what changes the number and the places of the Gaussians in a training.

A strategy is one class: `MCMC`, or one of another package (entry point in ``cleargs.densifiers``). The
setting ``g0.densify`` names it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import NDArray

from cleargs.plugins import load_plugin
from cleargs.random_streams import Stream
from cleargs.splat.config import MCMC_NAME, OFF, TrainConfig

if TYPE_CHECKING:
    from torch import Tensor

    from cleargs.splat.gaussians import Gaussians
    from cleargs.splat.types import Moments

ERROR_STEPS = 5
"""Number of steps before a refinement that measure its errors, one frame each. Each costs a backward pass, so
at most an eighth of the steps between refinements measure errors."""

NOISE_EVERY = 4
"""Number of steps from one noise on the means to the next, which has the variance of this many."""


@dataclass
class DensifierState:
    """The state of a training after a step. A strategy may change or replace the first three fields."""

    gaussians: Gaussians
    moments: Moments
    """Adam's running means, with the rows of ``gaussians``."""
    errors: Tensor | None  # [N] >= 0
    """Each Gaussian's part of the errors of the frames, summed over the steps with `Densifier.wants_errors`
    until the strategy sets this to None."""
    step: int
    """Number of finished steps of the whole schedule."""
    seed: tuple[int, ...]
    """Seed of the training. Random numbers may depend on it and on ``step`` only."""
    rate_of_means: float
    """Learning rate of the means in this step."""
    require_finite: Callable[[], None]
    """Raises StageError if a parameter is not finite."""


class Densifier(Protocol):
    """A strategy. It is called with the settings of a training, in which the steps and the budget are set.

    It has no memory from step to step except ``errors``, so that a training can resume from a checkpoint.
    """

    def wants_errors(self, step: int) -> bool:
        """Return True if the next step, after ``step`` finished ones, must add to the errors."""

    def after_step(self, state: DensifierState) -> None:
        """Change the Gaussians after a step. New rows need moments."""

    def expected_counts(self, start: int) -> NDArray[np.float64]:
        """Return the expected number of Gaussians in each step of the training, [length], from ``start``.

        The last one becomes the ``budget`` of G0, and G0 starts from a part of it (`planned_start`).
        """


class MCMC:
    """The strategy of `cleargs.splat.densification`: refinements at even intervals, noise in between."""

    def __init__(self, config: TrainConfig) -> None:
        self._config = config

    def wants_errors(self, step: int) -> bool:
        """Return True in the last steps before a refinement."""
        interval = self._config.refine_interval
        refined = -(-(step + 1) // interval) * interval
        return refined - (step + 1) < min(ERROR_STEPS, max(1, interval // 8)) and self._refines(refined)

    def after_step(self, state: DensifierState) -> None:
        """Refine the Gaussians if it is due and errors were measured, then add noise to the means."""
        from cleargs.splat.backend import backend_for  # torch, which an estimate does not need

        config, backend = self._config, backend_for(state.gaussians.device)
        if self._refines(state.step):
            state.require_finite()  # a refinement would relocate Gaussians with NaN opacity
            if state.errors is not None:
                assert config.budget is not None
                state.gaussians, state.moments = backend.refine(
                    state.gaussians,
                    state.moments,
                    errors=state.errors,
                    rate=config.growth,
                    budget=config.budget,
                    min_opacity=config.min_opacity,
                    seed=(*state.seed, Stream.REFINEMENT, state.step),
                )
                state.errors = None
        if config.noise > 0.0 and state.step % NOISE_EVERY == 0:
            backend.add_position_noise(
                state.gaussians,
                amount=math.sqrt(NOISE_EVERY) * config.noise * state.rate_of_means,
                min_opacity=config.min_opacity,
                seed=(*state.seed, Stream.POSITION_NOISE, state.step),
            )

    def expected_counts(self, start: int) -> NDArray[np.float64]:
        """Return the numbers with the maximum growth in every refinement."""
        config, first = self._config, self._config.first
        counts = np.full(config.length, float(start))
        if config.budget is not None and start < config.budget:
            for step in filter(self._refines, range(first + 1, first + config.length)):
                counts[step - first :] = min(config.budget, int((1.0 + config.growth) * counts[step - first]))
        return counts

    def _refines(self, step: int) -> bool:
        config = self._config
        within = config.refine_start * config.planned <= step <= config.refine_stop * config.planned
        return step % config.refine_interval == 0 and within


def load_densifier(config: TrainConfig) -> Densifier | None:
    """Return the strategy that the settings name; None if it is off.

    Raises InputError if no package provides it, or if its import fails.
    """
    if config.densify == OFF:
        return None
    maker: Callable[[TrainConfig], Densifier] = (
        MCMC if config.densify == MCMC_NAME else load_plugin("densifiers", config.densify)
    )
    return maker(config)
