"""Densification after "3D Gaussian Splatting as Markov Chain Monte Carlo" (Kheradmand et al. 2024).

As there, dead Gaussians move, the number grows to a hard budget, and noise that only transparent Gaussians
feel is added to the means. But the error says where, not opacity: what takes part in pixels that are far from
their frames (Rota Bulò et al., "Revising densification in Gaussian splatting", 2024) is cut in two along its
longest axis (Deng et al., "Efficient density control", 2024); the dead become halves, as the new ones are.
Drawn by opacity, copies at one place take long to part, and what lies in the dark or behind the sparse points
gets none.

The rules of a refinement are in `cleargs.splat.strategy.rules`; the noise, of every step, is a kernel. A GPU
has the same rules, and draws other random numbers.
"""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor

from cleargs.random_streams import Stream
from cleargs.splat.backend import backend_for
from cleargs.splat.config import TrainConfig
from cleargs.splat.gaussians import Gaussians
from cleargs.splat.types import Moments


class MCMC:
    """Change the number and the places of the Gaussians of a training, of which there may be ``budget``.

    Random numbers are drawn afresh from (seed, `Stream`, step), and what is remembered from step to step is
    in `state`: a resumed training is the same training. Steps count from 1, along the schedule.
    """

    def __init__(self, config: TrainConfig, budget: int, seed: Sequence[int]) -> None:
        self._config = config
        self._budget = budget
        self._seed = tuple(seed)
        self._errors: Tensor | None = None  # [N]

    def add_errors(self, errors: Tensor) -> None:
        """Add what each Gaussian contributes to squared errors of this step's frame: [N], at least 0.

        The sum over the pixels of the squared difference (times the frame's weight) times the Gaussian's
        share in the pixel.
        """
        self._errors = errors.clone() if self._errors is None else self._errors + errors

    def refine(self, gaussians: Gaussians, moments: Moments, step: int) -> tuple[Gaussians, Moments]:
        """Cut what takes part in errors; without any there is nothing to do.

        Returns the Gaussians to continue with and their moments; those given must not be used again.
        """
        errors, self._errors = self._errors, None
        if errors is None:
            return gaussians, moments
        return backend_for(gaussians.device).refine(
            gaussians,
            moments,
            errors=errors,
            rate=self._config.growth,
            budget=self._budget,
            min_opacity=self._config.min_opacity,
            seed=(*self._seed, Stream.REFINEMENT, step),
        )

    def after_step(self, gaussians: Gaussians, rate: float, step: int) -> None:
        """Add the noise of a step to the means, whose learning rate is ``rate``."""
        config = self._config
        if config.noise > 0.0:
            backend_for(gaussians.device).add_position_noise(
                gaussians,
                amount=config.noise * rate,
                min_opacity=config.min_opacity,
                seed=(*self._seed, Stream.POSITION_NOISE, step),
            )

    def state(self) -> dict[str, Tensor]:
        """The errors since the last refinement."""
        return {} if self._errors is None else {"errors": self._errors}

    def restore(self, state: dict[str, Tensor]) -> None:
        """Resume from what `state` gave."""
        self._errors = state.get("errors")
