"""What a training is expected to take, from its settings and its views."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, TypeVar

import numpy as np
from numpy.typing import NDArray

from cleargs.splat.config import TrainConfig

if TYPE_CHECKING:
    from cleargs.splat.views import TrainingView

# Wall seconds of a step on two quiet cores: fixed, a megapixel, a Gaussian.
STEP_S, STEP_S_PER_MEGAPIXEL, STEP_S_PER_GAUSSIAN = 0.002, 0.12, 4.5e-7
# And a megapixel of a frame that is asked what its camera did: the first time, and again.
SEARCH_S, SEARCH_AGAIN_S = 4.0, 1.0

Settings = TypeVar("Settings", bound=TrainConfig)


def gaussians_by_step(config: TrainConfig, start: int) -> NDArray[np.float64]:
    """How many Gaussians each step has, [length], where they grow from ``start`` as fast as they may."""
    first, planned = config.first, config.planned
    counts = np.full(config.length, float(start))
    if not config.densify or config.budget is None or start >= config.budget:
        return counts
    refined = np.arange(config.refine_interval, first + config.length, config.refine_interval)
    between = (refined >= config.refine_start * planned) & (refined <= config.refine_stop * planned)
    for step in refined[between & (refined > first)] - first:
        counts[step:] = min(config.budget, int((1.0 + config.growth) * counts[step]))
    return counts


def seconds_by_step(config: TrainConfig, frames: int, megapixels: float, start: int) -> NDArray[np.float64]:
    """Rough wall seconds of each step on two quiet cores, [length]: steps late in a training take longer.

    ``config`` is decided; ``frames`` of ``megapixels`` each are trained on, from ``start`` Gaussians.
    """
    step = config.first + np.arange(config.length)
    reduced = np.where(step < config.coarse_share * config.planned, config.coarse_factor**2, 1.0)
    seconds = STEP_S + STEP_S_PER_MEGAPIXEL * megapixels * reduced
    seconds += STEP_S_PER_GAUSSIAN * gaussians_by_step(config, start)
    if config.formation.enabled:
        since = step - max(config.first, config.formation.start * config.planned)
        again = SEARCH_AGAIN_S / config.formation.every
        seconds += megapixels * np.where(since < 0, 0.0, np.where(since < frames, SEARCH_S, again))
    return seconds


def training_cost(
    config: TrainConfig, frames: int, megapixels: float, start: int | None = None
) -> tuple[float, float]:
    """Rough wall seconds on two quiet cores, and GB beside the images, of a training on so many frames from
    ``start`` Gaussians (None: from as many as it may have).
    """
    pixels = round(frames * megapixels * 1e6)
    budget = config.budget_for(pixels)
    whole = config.model_copy(update={"steps": config.steps_for(frames), "budget": budget})
    seconds = seconds_by_step(whole, frames, megapixels, budget if start is None else min(start, budget))
    return float(seconds.sum()), 1.5e-6 * budget


def resolve_config(config: Settings, views: Sequence[TrainingView]) -> Settings:
    """``config`` with the steps and the budget that it leaves open, for these views."""
    pixels = sum(view.camera.width * view.camera.height for view in views)
    update = {"steps": config.steps_for(len(views)), "budget": config.budget_for(pixels)}
    return config.model_copy(update=update)
