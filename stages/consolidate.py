"""Full-Trajectory Repair Consolidation: a last training on frame images and every frame's latest repair."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pydantic import Field

from cleargs.base_model import FrozenModel
from cleargs.pipeline.stage import Estimate, StageContext, StageResult
from cleargs.random_streams import Stream
from cleargs.scene.folder import LOG, TRAINED, SceneFolder

from .config import MAX_ROUNDS, REPAIR_LIBRARIES, ROUNDS_END, DistilConfig
from .config import other_libraries as other_libraries


class FinalDistilConfig(DistilConfig):
    """Settings of the final distillation (training on frame images and repairs)."""

    begin: float = Field(
        ROUNDS_END, ge=0, lt=1, description="start of this training in the schedule, as a fraction"
    )


class ConsolidateConfig(FrozenModel):
    """Full-Trajectory Repair Consolidation. The limits for its scene are in [rivr.harm]."""

    scorer: str = Field(
        "clarity-net",
        description="measures harm, whose limits are in [rivr.harm]: the name of a scorer, or an ONNX file",
        json_schema_extra={"key": False, "plugin": "scorers"},  # the key contains the digest of its file
    )
    distil: FinalDistilConfig = Field(FinalDistilConfig(), description="the final distillation")


VERSION = 70
CONFIG = ConsolidateConfig
SETTINGS = ("g0", "rivr")
INPUTS: Mapping[str, tuple[str, ...]] = {
    "ingest": ("frames.parquet", "motion.parquet", "images", "masks", "movers.parquet"),
    "rva": ("frames.parquet",),
    "g0": TRAINED,
    "rivr": (*TRAINED, "selection.parquet", *(f"round_{number:02d}" for number in range(1, MAX_ROUNDS + 1))),
}
OUTPUTS = (*TRAINED, LOG, "repairs.parquet")
LEFTOVERS: tuple[str, ...] = ()
LIBRARIES = REPAIR_LIBRARIES


def externals(config: ConsolidateConfig, source: Path) -> Mapping[str, Path]:
    """Return the scorer's model file, whose content enters the key; no file for another package's scorer."""
    from cleargs.models.registry import model_file

    path = model_file(config.scorer, "scorer")
    return {} if path is None else {"scorer": path}


def preflight(config: ConsolidateConfig) -> None:
    """Load the scorer. Raises InputError if it is not installed, is damaged, or cannot be used."""
    from cleargs.models.scorer import load_scorer

    load_scorer(config.scorer)


def idle(sections: Mapping[str, Any]) -> bool:
    """Return True if no repair is made."""
    return bool(sections["rivr"].rounds == 0)


def estimate(context: StageContext[ConsolidateConfig]) -> Estimate:
    """Return the cost of the training."""
    from .cost import distillation, expected

    g0 = context.settings["g0"]
    if idle(context.settings):
        return Estimate(minutes=0.0, memory_gb=1.0, disk_gb=0.0)
    return expected(context, distillation(context, context.config.distil), g0.cache_mb)


def run(context: StageContext[ConsolidateConfig]) -> StageResult:
    """Train RIVR's scene on frame images and the latest accepted repairs, and check the result for harm."""
    from cleargs.formation.measured import load_paths
    from cleargs.models.onnx import network_device
    from cleargs.models.scorer import load_scorer
    from cleargs.rivr import tables
    from cleargs.rivr.distillation import check_harm, distil
    from cleargs.rivr.rounds import pseudo_view
    from cleargs.rivr.summaries import ConsolidateSummary
    from cleargs.rivr.targets import load_supervision
    from cleargs.scene.viewer import SceneViewer
    from cleargs.splat.backend import set_threads

    config, threads, reporter = context.config, context.threads, context.reporter
    rivr, harm = context.inputs["rivr"], context.settings["rivr"].harm
    set_threads(threads)
    supervision = load_supervision(context.inputs["ingest"], context.inputs["rva"], harm.control)
    if idle(context.settings):
        return _unchanged(context)
    scorer = load_scorer(config.scorer, network_device(context.device, reporter.warn))
    rows = tables.read_selection(rivr / "selection.parquet")
    repairs, kept = tables.latest_accepted(rows), tables.kept_raw(rows)
    unrepaired = kept.intersection(row.frame_id for row in rows if row.exr is not None)
    tables.write_repairs(context.out / "repairs.parquet", repairs)

    measured = load_paths(context.inputs["ingest"])
    g0 = SceneViewer(context.inputs["g0"], context.device, measured)
    start = SceneViewer(rivr, context.device, measured) if repairs or kept else g0
    consolidated, trainings = start, list[SceneFolder]()
    if repairs or kept:
        pseudo = [pseudo_view(supervision.views[row.frame_id], row, rivr) for row in repairs]
        consolidated = distil(
            start,
            [*supervision.real, *pseudo],
            config.distil.applied_to(context.settings["g0"], len(supervision.real)),
            context.checkpoints / "consolidation",
            seed=(context.seed, Stream.CONSOLIDATION),
            label="consolidating",
            round=0,
            pseudo_share=config.distil.pseudo_share,
            pseudo_weight=config.distil.pseudo_weight,
            repaired=tables.repaired_share(rows),
            reporter=reporter,
        )
        trainings.append(consolidated.files)

    checked = check_harm(
        g0, consolidated, supervision, scorer, harm, threads, repaired=any(row.accepted for row in rows)
    )
    final, rejected = (consolidated, None) if checked.harm is None else (start, consolidated.files)
    if rejected is not None:
        reporter.warn(
            f"the consolidated scene is rejected, RIVR's stays: {checked.harm} on the control frames"
        )
    final.files.publish(trainings, context.out, rejected)

    better = "consolidated scene" if checked.harm is None else "RIVR's scene"
    return StageResult(
        summary=ConsolidateSummary(
            repairs=len(repairs),
            chosen=tables.chosen_counts(repairs) | {"observed": len(unrepaired)},
            latest_rounds=dict(sorted(Counter(str(row.round) for row in repairs).items())),
            scorer=scorer.name,
            control=checked,
            published=better if repairs or kept else "G0",
            psnr_unseen=final.psnr_unseen(supervision.real),
        ).figures()
    )


def _unchanged(context: StageContext[ConsolidateConfig]) -> StageResult:
    """Publish G0's scene unchanged."""
    from cleargs.rivr.summaries import ConsolidateSummary
    from cleargs.rivr.tables import write_repairs

    context.reporter.info("consolidation: without repairs, the scene is G0's, unchanged")
    write_repairs(context.out / "repairs.parquet", [])
    SceneFolder(context.inputs["g0"]).publish([], context.out, None)
    return StageResult(summary=ConsolidateSummary(repairs=0, published="G0").figures())
