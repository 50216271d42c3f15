"""RVA: rate each training frame by its image quality and its position in the scene, and set its weight."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from cleargs.pipeline.stage import Estimate, StageContext, StageResult
from cleargs.rva.config import AssessmentConfig, EvaluatorConfig


class RvaConfig(AssessmentConfig, EvaluatorConfig):
    """Reliability-aware View Allocation. The defaults are those of the paper, except `active_share`."""


VERSION = 6
CONFIG = RvaConfig
SETTINGS: tuple[str, ...] = ()
INPUTS: Mapping[str, tuple[str, ...]] = {
    "ingest": ("frames.parquet", "points.parquet", "observations.parquet", "images", "masks")
}
OUTPUTS = ("frames.parquet", "bins.parquet")
LEFTOVERS: tuple[str, ...] = ()
LIBRARIES = ("numpy", "scipy", "opencv-contrib-python-headless")

_SECONDS_PER_MEGAPIXEL = 0.1  # on one core, including decoding
_REPLIES_PER_MINUTE = 20  # from a vision-language model, per connection: a guess, since the server is unknown


def externals(config: RvaConfig, source: Path) -> Mapping[str, Path]:
    """Return no file: all inputs are in the store."""
    return {}


def preflight(config: RvaConfig) -> None:
    """Check the evaluator. Raises InputError if its server does not answer or does not have the model."""
    from cleargs.rva.evaluators import check_evaluator

    check_evaluator(config)


def estimate(context: StageContext[RvaConfig]) -> Estimate:
    """Estimate the cost: time for the cues, and memory for a few images per thread."""
    from .cost import capture_size

    config = context.config
    frames, megapixels = capture_size(context)
    minutes = _SECONDS_PER_MEGAPIXEL * megapixels * frames / context.threads / 60
    if config.evaluator == "qwen3-vl":
        minutes = frames / (_REPLIES_PER_MINUTE * config.qwen.concurrency)
    return Estimate(minutes=minutes, memory_gb=0.3, disk_gb=0.001)


def run(context: StageContext[RvaConfig]) -> StageResult:
    """Compute cues, R (reliability), B (degradation risk), geometry, roles and weights; write both tables.

    A frame that the evaluator could not score is treated like a frame without a pose: it is in no set
    and has weight 0. The result of the stage is then partial.
    """
    import numpy as np

    from cleargs.capture.tables import load_frames, load_observations, load_points
    from cleargs.parquet import write_table
    from cleargs.rva.assessment import Observations, assess, bins_table, frames_table, poses_from, summary
    from cleargs.rva.evaluator import EvaluatedFrame, evaluated, label
    from cleargs.rva.evaluators import make_evaluator
    from cleargs.rva.hidden import with_hidden_parts
    from cleargs.rva.tables import BINS, FRAMES

    config, ingest = context.config, context.inputs["ingest"]
    frames = [frame for frame in load_frames(ingest) if frame.split == "train"]
    observations = Observations(*load_observations(ingest))

    evaluator = make_evaluator(config, seed=context.seed, device=context.device, cache=context.cache)
    views = [
        EvaluatedFrame(frame.frame_id, ingest / frame.image, ingest / frame.mask if frame.mask else None)
        for frame in frames
    ]
    cues = evaluated(evaluator, views, threads=context.threads, reporter=context.reporter)
    cues = with_hidden_parts(cues, frames, load_points(ingest), observations)
    frame_id = np.array([frame.frame_id for frame in frames], dtype=np.int32)
    result = assess(frame_id, cues, poses_from(frames), observations, config)

    names = [frame.name for frame in frames]
    write_table(
        context.out / "frames.parquet", frames_table(frame_id, names, label(evaluator), cues, result), FRAMES
    )
    write_table(context.out / "bins.parquet", bins_table(frame_id, result), BINS)
    figures = summary(result, label(evaluator))
    if figures["fallback"]:
        context.reporter.warn(
            "no frame is reliable; the best frames by R - B replace reliable frames in the geometric utility"
        )
    missing = tuple(
        f"frame {frame.frame_id} ({frame.name}) was not scored"
        for frame, row in zip(frames, cues, strict=True)
        if np.isnan(row).any()
    )
    return StageResult(missing, figures)
