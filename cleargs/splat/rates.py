"""Learning rates of a training, by parameter and step."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from cleargs.splat.config import TrainConfig

SH_REST_DIVISOR = 5.0
"""The SH terms above the constant learn this much slower. (Inria: 20, at which highlights take more steps
than a CPU has.)"""
INRIA_STEPS = 30_000
"""Steps of the training that the rates of 3DGS are made for."""
MAX_RATE_FACTOR = 6.0


def rate_factor(steps: int) -> float:
    """How much faster means, scales, rotations and SH learn in a training of so many steps than in one of
    `INRIA_STEPS`: a step of Adam is as long as its rate, so a short training with the rates of a long one
    ends before they have got where they go (docs/training.md)."""
    return min(MAX_RATE_FACTOR, max(1.0, math.sqrt(INRIA_STEPS / steps)))


class Rates:
    """Learning rates by parameter name. The world is normalised, so the scene's extent is 1."""

    def __init__(self, config: TrainConfig, coefficients: int, device: torch.device | str = "cpu") -> None:
        self._config = config
        factor = rate_factor(config.planned) if config.rate_factor is None else config.rate_factor
        self._factor = factor
        sh = torch.full((coefficients * 3,), factor * config.lr_sh / SH_REST_DIVISOR, device=device)
        sh[:3] = factor * config.lr_sh
        self._first: dict[str, float | Tensor] = {
            "log_scales": factor * config.lr_scales,
            "rotations": factor * config.lr_rotations,
            "logit_opacities": config.lr_opacities,
            "sh": sh,
        }

    def means(self, step: int) -> float:
        """Rate of the means before step ``step``, counted from 0 along the schedule."""
        return (
            self._factor
            * self._config.lr_means
            * float(self._config.lr_means_final ** (step / self._config.planned))
        )

    def at(self, step: int) -> dict[str, float | Tensor]:
        """Every rate before step ``step``, counted from 0 along the schedule."""
        left = float(self._config.lr_final ** (step / self._config.planned))
        return {"means": self.means(step), **{name: rate * left for name, rate in self._first.items()}}
