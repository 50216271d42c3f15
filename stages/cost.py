"""Estimates of the cost of the stages that train."""

from __future__ import annotations

from contextlib import suppress
from typing import TYPE_CHECKING, Any

from cleargs.capture.tables import load_frames, load_points
from cleargs.errors import StoreError
from cleargs.pipeline.stage import Estimate, StageContext
from cleargs.splat.budget import TrainingCost, planned_start, resolved, training_cost

if TYPE_CHECKING:
    from cleargs.scene.config import G0Config

    from .config import DistilConfig

_UNKNOWN = (60, 0.5)  # number of frames, and megapixels per frame, that are assumed for an unknown capture
_POINTS_PER_FRAME = 250  # assumed before ingest: captures of 16 to 150 frames gave 80 to 350 sparse points
_SERIAL = 0.1  # share of the work that is not parallel (a guess)


def capture_size(context: StageContext[Any]) -> tuple[int, float]:
    """Return the number of placed training frames and megapixels of the largest; estimates before ingest."""
    if (expected := context.expected.get("ingest")) is not None and expected.frames:
        return expected.frames, expected.megapixels
    if "ingest" in context.inputs:
        with suppress(StoreError):
            frames = [f for f in load_frames(context.inputs["ingest"]) if f.registered and f.split == "train"]
            return len(frames), max((f.width * f.height for f in frames), default=0) / 1e6
    return _UNKNOWN


def _sparse_points(context: StageContext[Any]) -> int:
    """Return the number of sparse points. Estimate it before ingest, and if the points cannot be read."""
    if "ingest" in context.inputs:
        with suppress(StoreError):
            return len(load_points(context.inputs["ingest"]).point_id)
    return _POINTS_PER_FRAME * capture_size(context)[0]


def first_training(context: StageContext[Any], g0: G0Config) -> TrainingCost:
    """Return the cost of G0."""
    frames, megapixels = capture_size(context)
    config = resolved(g0, frames, round(frames * megapixels * 1e6))
    config, start = planned_start(config, _sparse_points(context), g0.min_points)
    return training_cost(config, frames, megapixels, start)


def distillation(context: StageContext[Any], config: DistilConfig) -> TrainingCost:
    """Return the cost of a training with the settings ``config`` that continues G0's scene."""
    g0, (frames, megapixels) = context.settings["g0"], capture_size(context)
    start = first_training(context, g0).gaussians
    return training_cost(config.applied_to(g0, frames), frames, megapixels, start)


def expected(context: StageContext[Any], cost: TrainingCost, cache_mb: int, seconds: float = 0.0) -> Estimate:
    """Return the cost of a stage with this training, and ``seconds`` of other work on two idle cores.

    Memory is taken by libraries, Gaussians (1.4 to 2.2 kB each in four real captures) and decoded images, up
    to ``cache_mb``. Disk is taken by the scene and its moments, 0.7 kB per Gaussian of SH degree 3.
    """
    frames, megapixels = capture_size(context)
    return Estimate(
        minutes=(cost.seconds + seconds) * thread_factor(context.threads) / 60.0,
        memory_gb=0.85 + 2.0e-6 * cost.gaussians + min(cache_mb / 1024, 0.003 * megapixels * frames),
        disk_gb=0.7e-6 * cost.gaussians,
    )


def thread_factor(threads: int) -> float:
    """Return the time on ``threads`` threads relative to the measurements on two threads (Amdahl's law)."""
    return (_SERIAL + (1.0 - _SERIAL) / threads) / (_SERIAL + (1.0 - _SERIAL) / 2)
