"""Expected cost of a training, from its settings and views."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from cleargs.splat.config import TrainConfig
from cleargs.splat.densifier import load_densifier

if TYPE_CHECKING:
    from cleargs.splat.views import TrainingView

# Wall seconds of a step on two idle cores of an Intel Xeon (Emerald Rapids, AVX-512): a constant, and the
# parts that grow with the image and with the number of Gaussians.
STEP_S, STEP_S_PER_MEGAPIXEL, STEP_S_PER_GAUSSIAN = 0.002, 0.12, 4.5e-7
# Wall seconds per megapixel to estimate a frame's image formation: for the first time, under the assumption
# that half of the frames are searched, and for later times.
SEARCH_S, SEARCH_AGAIN_S = 0.6, 0.3

START_SHARE = 0.4
"""Share of its final number of Gaussians that a first training starts from (docs/experiments/training.md)."""

Settings = TypeVar("Settings", bound=TrainConfig)


def gaussians_by_step(config: TrainConfig, start: int) -> NDArray[np.float64]:
    """Return the expected number of Gaussians at each step, [length], from ``start``."""
    densifier = load_densifier(config)
    return np.full(config.length, float(start)) if densifier is None else densifier.expected_counts(start)


def seconds_by_step(config: TrainConfig, frames: int, megapixels: float, start: int) -> NDArray[np.float64]:
    """Estimate the wall seconds of each step on two idle cores, [length].

    Later steps take longer, as the number of Gaussians grows from ``start``. ``megapixels`` are per frame.
    ``config`` is one of `resolve_config`.
    """
    step = config.first + np.arange(config.length)
    reduced = np.where(step < config.coarse_steps, config.coarse_factor**2, 1.0)
    seconds = STEP_S + STEP_S_PER_MEGAPIXEL * megapixels * reduced
    seconds += STEP_S_PER_GAUSSIAN * gaussians_by_step(config, start)
    if config.formation.enabled:
        since = step - config.formation.start * config.planned
        again = SEARCH_AGAIN_S / config.formation.every
        seconds += megapixels * np.where(since < 0, 0.0, np.where(since < frames, SEARCH_S, again))
    return seconds


class TrainingCost(NamedTuple):
    """Estimated cost of a training."""

    seconds: float  # wall seconds on two idle cores
    gaussians: int  # number at the end


def training_cost(config: TrainConfig, frames: int, megapixels: float, start: int) -> TrainingCost:
    """Estimate the cost of a training that begins with ``start`` Gaussians. ``megapixels`` are per frame.

    Numbers that are unset are chosen as in `resolve_config`.
    """
    whole = resolved(config, frames, round(frames * megapixels * 1e6))
    assert whole.budget is not None
    start = min(start, whole.budget)
    seconds = seconds_by_step(whole, frames, megapixels, start).sum()
    return TrainingCost(float(seconds), int(gaussians_by_step(whole, start)[-1]))


def planned_start(config: Settings, points: int, at_least: int) -> tuple[Settings, int]:
    """Return ``config`` with its final number of Gaussians as budget, and the number to start from.

    The final number is what growth would reach from one Gaussian per sparse point, or from ``at_least``.
    ``points`` is the number of sparse points. Steps and budget of ``config`` must be set.
    """
    assert config.budget is not None
    start = min(max(points, at_least), config.budget)
    final = int(gaussians_by_step(config, start)[-1])
    return config.model_copy(update={"budget": final}), max(start, round(START_SHARE * final))


def resolve_config(config: Settings, views: Sequence[TrainingView]) -> Settings:
    """Return ``config`` with steps, budget and share of reduced images; unset ones follow from the views."""
    return resolved(config, len(views), sum(view.camera.width * view.camera.height for view in views))


def resolved(config: Settings, frames: int, pixels: int) -> Settings:
    """Return ``config`` with these three numbers for active frames with ``pixels`` pixels in total."""
    update = {
        "steps": config.steps_for(frames),
        "budget": config.budget_for(pixels),
        "coarse_share": config.coarse_share_for(pixels // max(1, frames)),
    }
    return config.model_copy(update=update)
