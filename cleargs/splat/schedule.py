"""The schedule of a training: rates, image size and SH degree at each step."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from cleargs.random_streams import Stream
from cleargs.splat.config import TrainConfig
from cleargs.splat.scene import Colour
from cleargs.splat.types import Rates

SH_REST_DIVISOR = 5.0
"""Divisor of the rate of the SH terms above the constant (Inria: 20, with which highlights need more steps
than a training on a CPU has)."""
INRIA_STEPS = 30_000
"""Number of steps for which the rates of 3DGS were chosen."""
MAX_RATE_FACTOR = 6.0
"""Upper limit of `rate_factor` (docs/training.md)."""

TEXTURE_FROM, TEXTURE_EVERY = 0.7, 3
"""Share of the schedule from which the term of texture is in the loss of every third step. Earlier,
shapes are coarse (docs/experiments/training.md)."""


def rate_factor(steps: int) -> float:
    """Return the factor on the rates of means, scales, rotations and SH for a schedule of ``steps`` steps.

    The rates of 3DGS are for `INRIA_STEPS`. The length of a step of Adam is about its rate, so a shorter
    training needs larger rates to cover the same distance (docs/training.md).
    """
    return min(MAX_RATE_FACTOR, max(1.0, math.sqrt(INRIA_STEPS / steps)))


def random_grey(seed: Sequence[int], step: int) -> Colour:
    """Return the colour behind the scene in a step, if the settings name none.

    Only an opaque pixel can match the frame image over every grey, so filmed surfaces become opaque.
    Over black alone, dark parts of the scene stay transparent. Random colours instead of greys make the
    gradients noisier and the scenes a little softer (docs/experiments/training.md).
    """
    grey = float(np.random.default_rng([*seed, Stream.BACKGROUND, step]).random())
    return grey, grey, grey


class Schedule:
    """Values of the schedule at each step.

    In all methods ``step`` is the number of finished steps of the whole schedule. Rates of means are in units
    of the normalised world, so they need no factor for the extent of the scene (Inria: ``spatial_lr_scale``).
    ``config`` is one of `cleargs.splat.budget.resolve_config`.
    """

    def __init__(self, config: TrainConfig) -> None:
        self._config = config
        factor = rate_factor(config.planned) if config.rate_factor is None else config.rate_factor
        self._factor = factor
        self._sh = factor * config.lr_sh, factor * config.lr_sh / SH_REST_DIVISOR

    def rate_of_means(self, step: int) -> float:
        """Return the learning rate of the means."""
        decay = float(self._config.lr_means_final ** (step / self._config.planned))
        return self._factor * self._config.lr_means * decay

    def rates(self, step: int) -> Rates:
        """Return every learning rate. Those of the SH are rounded to float32."""
        config, factor = self._config, self._factor
        left = float(config.lr_final ** (step / config.planned))
        sh, sh_rest = (float(np.float32(rate) * np.float32(left)) for rate in self._sh)
        return Rates(
            self.rate_of_means(step),
            factor * config.lr_scales * left,
            factor * config.lr_rotations * left,
            config.lr_opacities * left,
            sh,
            sh_rest,
        )

    def image_factor(self, step: int) -> float:
        """Return the factor on width and height of the training images."""
        return self._config.coarse_factor if step < self._config.coarse_steps else 1.0

    def sh_degree(self, step: int, largest: int) -> int:
        """Return the SH degree to render, at most the stored degree ``largest``."""
        every = self._config.sh_every * self._config.planned
        return largest if every == 0 else min(largest, int(step / every))

    def sees_texture(self, step: int) -> bool:
        """Return True if the next step has the term of texture in its loss."""
        return step >= TEXTURE_FROM * self._config.planned and step % TEXTURE_EVERY == 0
