"""G0: the first scene, from the sparse points and the frames that RVA keeps, each with its weight."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from cleargs.pipeline.stage import Estimate, StageContext, StageResult
from cleargs.scene.config import G0Config, kernel_libraries
from cleargs.scene.folder import LOG, TRAINED

VERSION = 66
CONFIG = G0Config
SETTINGS: tuple[str, ...] = ()
INPUTS: Mapping[str, tuple[str, ...]] = {
    "ingest": (
        "frames.parquet",
        "points.parquet",
        "observations.parquet",
        "motion.parquet",
        "images",
        "masks",
        "movers.parquet",
    ),
    "rva": ("frames.parquet",),
}
OUTPUTS = (*TRAINED, LOG)
LEFTOVERS: tuple[str, ...] = ()
LIBRARIES = ("torch", "numba", "numpy", "scipy", "opencv-contrib-python-headless")
other_libraries = kernel_libraries


def externals(config: G0Config, source: Path) -> Mapping[str, Path]:
    """Return no file: all inputs are in the store."""
    return {}


def preflight(config: G0Config) -> None:
    """Load the strategy of densification. Raises InputError if another package lacks it."""
    from cleargs.splat.budget import training_cost

    training_cost(config, frames=1, megapixels=0.1, start=1)


def estimate(context: StageContext[G0Config]) -> Estimate:
    """Return the cost of the training."""
    from .cost import expected, first_training

    return expected(context, first_training(context, context.config), context.config.cache_mb)


def run(context: StageContext[G0Config]) -> StageResult:
    """Make Gaussians from the sparse points and train them on the active frames with their RVA weights."""
    from cleargs.capture.tables import load_frames, load_points
    from cleargs.formation.capture import CaptureFormation
    from cleargs.formation.exposure import Exposure, frame_gains, gain_spread
    from cleargs.formation.measured import load_paths
    from cleargs.formation.movement import TOLERANCE
    from cleargs.parquet import read_table
    from cleargs.rivr.summaries import G0Summary
    from cleargs.rva.tables import FRAMES as RVA_FRAMES
    from cleargs.scene.measure import pooled_unseen
    from cleargs.scene.training import train_into
    from cleargs.scene.views import real_views, seen_points
    from cleargs.splat.backend import mean_psnr, set_threads
    from cleargs.splat.budget import planned_start, resolve_config
    from cleargs.splat.initialise import starting_gaussians
    from cleargs.splat.scene import BLACK, Scene
    from cleargs.splat.views import require_views

    config, ingest = context.config, context.inputs["ingest"]
    set_threads(context.threads)
    allocation = read_table(context.inputs["rva"] / "frames.parquet", RVA_FRAMES).to_pylist()
    frames = load_frames(ingest)
    views = real_views(frames, {row["frame_id"]: row["weight"] for row in allocation}, ingest)
    require_views(views)
    sparse = seen_points(load_points(ingest), ingest, views)

    config, start = planned_start(resolve_config(config, views), len(sparse.xyz), config.min_points)
    gaussians = starting_gaussians(
        sparse,
        views,
        at_least=start,
        at_most=config.budget,
        sh_degree=config.sh_degree,
        seed=context.seed,
        say=lambda remark: context.reporter.info(f"G0: {remark}"),
    )
    gains = frame_gains(views, sparse)
    exposure_spread, colour_spread = gain_spread(gains)
    alike = exposure_spread <= config.exposure_threshold and colour_spread <= config.colour_threshold
    off = config.exposure == "off" or (config.exposure == "auto" and alike)
    exposure = None if off else Exposure.from_gains([view.frame_id for view in views], gains)
    looks = movement_expected(config, allocation, [frame.movers for frame in frames])
    formation = CaptureFormation(
        views,
        config.formation,
        exposure=exposure,
        lr_exposure=config.lr_exposure,
        tolerance=TOLERANCE if looks else 0.0,
        measured=load_paths(ingest),
    )
    trained, dropped, drawn_in, few, fits = train_into(
        context.out,
        Scene(gaussians, config.antialias, config.background or BLACK),
        views,
        config,
        formation,
        exposure=Exposure.identity([view.frame_id for view in views]),
        checkpoint=context.checkpoints / "g0.safetensors",
        reporter=context.reporter,
        label="G0",
        device=context.device,
        seed=(context.seed,),
    )
    psnr = {view.frame_id: fit.psnr for view, fit in zip(few, fits, strict=True)}
    strong = [row["frame_id"] for row in allocation if row["role"] == "strong"]
    return StageResult(
        summary=G0Summary(
            views=len(views),
            gaussians_start=gaussians.num,
            gaussians=trained.scene.gaussians.num,
            gaussians_dropped=dropped,
            gaussians_drawn_in=drawn_in,
            steps=config.length,
            sh_degree=gaussians.sh_degree,
            exposure=exposure is not None,
            exposure_spread=exposure_spread,
            colour_spread=colour_spread,
            moving_share=sum(float(cells.mean()) for cells in formation.moving.values()) / len(views),
            psnr_strong=mean_psnr(psnr[frame_id] for frame_id in strong if frame_id in psnr),
            psnr_active=mean_psnr(psnr.values()),
            psnr_unseen=pooled_unseen(fits),
        ).figures()
    )


def movement_expected(
    config: G0Config, allocation: Sequence[Mapping[str, Any]], movers: Sequence[Sequence[object] | None]
) -> bool:
    """Return True if the training must look for movement.

    ``allocation`` are RVA's rows of the frames, ``movers`` what is seen in them that may move (None: it was
    not looked for).
    """
    from cleargs.formation.movement import HIDING

    asked = config.formation.movement
    if asked == "auto" and any(boxes is not None for boxes in movers):
        return any(movers)
    return asked == "on" or (asked == "auto" and any(row["b_ghosting"] >= HIDING for row in allocation))
