"""What a training does at each step of its schedule: rates, size of images, SH degree, refinements."""

from __future__ import annotations

import math

import torch

from cleargs.splat.config import TrainConfig
from cleargs.splat.types import Rate

SH_REST_DIVISOR = 5.0
"""The SH terms above the constant learn this much slower. (Inria: 20, at which highlights take more steps
than a CPU has.)"""
INRIA_STEPS = 30_000
"""Steps of the training that the rates of 3DGS are made for."""
MAX_RATE_FACTOR = 6.0

ERROR_STEPS = 5
"""Steps before a refinement whose errors say what is to grow, one frame each. Where refinements follow each
other within eight times as many steps there are fewer, since each costs a backward pass."""


def rate_factor(steps: int) -> float:
    """How much faster means, scales, rotations and SH learn in a training of so many steps than in one of
    `INRIA_STEPS`: a step of Adam is as long as its rate, so a short training with the rates of a long one
    ends before they have got where they go (docs/training.md).
    """
    return min(MAX_RATE_FACTOR, max(1.0, math.sqrt(INRIA_STEPS / steps)))


class Schedule:
    """What ``config`` says of each step. ``step`` is how many steps of the whole schedule lie behind.

    The world is normalised, so the scene's extent is 1.
    """

    def __init__(self, config: TrainConfig, coefficients: int, device: torch.device | str = "cpu") -> None:
        self._config = config
        factor = rate_factor(config.planned) if config.rate_factor is None else config.rate_factor
        self._factor = factor
        sh = torch.full((coefficients * 3,), factor * config.lr_sh / SH_REST_DIVISOR, device=device)
        sh[:3] = factor * config.lr_sh
        self._first: dict[str, Rate] = {
            "log_scales": factor * config.lr_scales,
            "rotations": factor * config.lr_rotations,
            "logit_opacities": config.lr_opacities,
            "sh": sh,
        }

    def rate_of_means(self, step: int) -> float:
        """Return the learning rate of the means."""
        return (
            self._factor
            * self._config.lr_means
            * float(self._config.lr_means_final ** (step / self._config.planned))
        )

    def rates(self, step: int) -> dict[str, Rate]:
        """Return every learning rate by parameter name."""
        left = float(self._config.lr_final ** (step / self._config.planned))
        return {
            "means": self.rate_of_means(step),
            **{name: rate * left for name, rate in self._first.items()},
        }

    def image_factor(self, step: int) -> float:
        """Return the factor on width and height of the images."""
        config = self._config
        return config.coarse_factor if step < config.coarse_share * config.planned else 1.0

    def sh_degree(self, step: int, largest: int) -> int:
        """Return the SH degree in use, of Gaussians that store ``largest``."""
        every = self._config.sh_every * self._config.planned
        return largest if every == 0 else min(largest, int(step / every))

    def refines(self, step: int) -> bool:
        """Return whether a refinement is due after that many steps."""
        return step % self._config.refine_interval == 0 and self._refined(step)

    def wants_errors(self, step: int) -> bool:
        """Return whether the step after these adds to the errors by which the next refinement goes."""
        interval = self._config.refine_interval
        refined = -(-(step + 1) // interval) * interval
        return refined - (step + 1) < min(ERROR_STEPS, max(1, interval // 8)) and self._refined(refined)

    def _refined(self, step: int) -> bool:
        config = self._config
        return config.refine_start * config.planned <= step <= config.refine_stop * config.planned
