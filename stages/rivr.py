"""RIVR: render, restore, fuse, select and distil in rounds along the trajectory."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cleargs.pipeline.stage import Estimate, StageContext, StageResult
from cleargs.random_streams import Stream
from cleargs.scene.folder import LOG, TRAINED, SceneFolder

from .config import REPAIR_LIBRARIES, RivrConfig
from .config import other_libraries as other_libraries

if TYPE_CHECKING:
    from cleargs.rivr.rounds import RepairContext
    from cleargs.rivr.tables import Selection
    from cleargs.rivr.targets import Supervision
    from cleargs.scene.viewer import SceneViewer
    from cleargs.splat.views import TrainingView


AUTO_SHARE = 1 / 16
"""Share of the frames that `auto` is expected to repair, for estimates."""

VERSION = 73
CONFIG = RivrConfig
SETTINGS = ("g0",)
INPUTS: Mapping[str, tuple[str, ...]] = {
    "ingest": ("frames.parquet", "motion.parquet", "images", "masks", "movers.parquet"),
    "rva": ("frames.parquet",),
    "g0": TRAINED,
}
OUTPUTS = (*TRAINED, LOG, "selection.parquet")
LEFTOVERS = ("round_*/*.exr",)
LIBRARIES = REPAIR_LIBRARIES


def externals(config: RivrConfig, source: Path) -> Mapping[str, Path]:
    """Return the model files. Their content enters the key; for models of other packages, a version does."""
    from cleargs.models.registry import model_file

    files = {
        "expert": model_file(config.expert, "expert"),
        "primary scorer": model_file(config.primary_scorer, "scorer"),
        "tie-break scorer": model_file(config.tiebreak_scorer, "scorer"),
    }
    return {role: path for role, path in files.items() if path is not None}


def preflight(config: RivrConfig) -> None:
    """Load candidates and models. Raises InputError if one is not installed, is damaged, or unusable."""
    from cleargs.models.expert import load_expert
    from cleargs.models.scorer import load_scorer
    from cleargs.rivr.candidates import candidate

    for name in config.candidates:
        candidate(name)
    load_expert(config.expert)
    for name in (config.primary_scorer, config.tiebreak_scorer):
        load_scorer(name)


def idle(sections: Mapping[str, Any]) -> bool:
    """Return True if no repair is made."""
    return bool(sections["rivr"].rounds == 0)


def estimate(context: StageContext[RivrConfig]) -> Estimate:
    """Return the cost of the candidates and of the distillations.

    On two cores, per megapixel, undoing motion takes about 3 s, restoring 1 s (40 s with an expert other than
    the embedded one), and making and scoring candidates 2 s. The scene of every group is kept until the end.
    """
    from .cost import capture_size, distillation, expected

    config, g0 = context.config, context.settings["g0"]
    frames, megapixels = capture_size(context)
    if config.rounds == 0:
        return Estimate(minutes=0.0, memory_gb=1.0, disk_gb=0.0)
    targets = frames if config.targets == "all" else max(2, round(AUTO_SHARE * frames))
    deblurs = config.use_observation and config.undo_motion
    restorings = 1 if config.use_observation and not deblurs else config.rounds
    restoring = 1.0 if config.expert == "embedded" else 40.0
    seconds = megapixels * targets * (restoring * restorings + (5.0 if deblurs else 2.0) * config.rounds)
    cost = distillation(context, config.distil)
    whole = expected(context, cost, g0.cache_mb, seconds + (config.rounds - 1) * cost.seconds)
    groups = 1 if config.group is None else -(-targets // config.group)
    # A target's EXR took 4 to 9 MB per megapixel. The scene is a third of a scene with its moments.
    kept = config.rounds * (0.01 * megapixels * targets + groups * whole.disk_gb / 3.0)
    return replace(whole, disk_gb=whole.disk_gb + kept)


def run(context: StageContext[RivrConfig]) -> StageResult:
    """Make, score, choose and distil candidates, group by group and round by round; check for harm."""
    from cleargs.formation.measured import load_paths
    from cleargs.models.expert import load_expert
    from cleargs.models.onnx import network_device
    from cleargs.models.scorer import load_scorer
    from cleargs.rivr.distillation import check_harm
    from cleargs.rivr.need import frames_to_repair, untried_rows
    from cleargs.rivr.rounds import RepairContext, forget_other_frames
    from cleargs.rivr.summaries import RivrSummary
    from cleargs.rivr.tables import refused_repairs, round_figures, write_selection
    from cleargs.rivr.targets import load_supervision
    from cleargs.scene.viewer import SceneViewer
    from cleargs.splat.backend import set_threads

    config, threads, reporter = context.config, context.threads, context.reporter
    set_threads(threads)
    supervision = load_supervision(context.inputs["ingest"], context.inputs["rva"], config.harm.control)
    measured = load_paths(context.inputs["ingest"])
    g0 = SceneViewer(context.inputs["g0"], context.device, measured)
    if config.rounds == 0:
        return _unchanged(context, supervision, g0)
    chosen = frames_to_repair(config.targets, supervision, g0.formations)
    targets = [supervision.views[frame_id] for frame_id in chosen]
    forget_other_frames(context.out, config.rounds, targets)
    networks_on = network_device(context.device, reporter.warn)
    expert = load_expert(config.expert, networks_on)
    repairing = RepairContext(
        config,
        expert,
        primary=load_scorer(config.primary_scorer, networks_on),
        tiebreak=load_scorer(config.tiebreak_scorer, networks_on),
        cache=context.checkpoints / "restored",
        threads=threads,
    )
    reporter.info(f"RIVR: {len(targets)} of {len(supervision.views)} frames are tried")
    others = untried_rows(chosen, supervision, g0.formations)
    rows, trainings, current = _repair_and_distil(context, supervision, targets, others, repairing, g0)
    write_selection(context.out / "selection.parquet", rows)
    made = len(rows) - len(others)
    if 2 * (refused := refused_repairs(rows)) > made:
        reporter.warn(
            f"{refused} of {made} repairs by {expert.name} were refused: they agree with neither the "
            "frame image nor the render (the report shows them); the renders replace them"
        )

    repaired = any(row.accepted for row in rows)
    checked = check_harm(g0, current, supervision, repairing.primary, config.harm, threads, repaired=repaired)
    if checked.harm is not None:
        reporter.warn(f"the distilled scene is rejected, G0 stays: {checked.harm} on the control frames")
    final, rejected = (current, None) if checked.harm is None else (g0, current.files)
    final.files.publish(trainings, context.out, rejected)
    return StageResult(
        summary=RivrSummary(
            expert=expert.name,
            rounds=[round_figures(number, rows) for number in sorted({row.round for row in rows})],
            control=checked,
            published="distilled scene" if checked.harm is None else "G0",
            psnr_unseen=final.psnr_unseen(supervision.real),
        ).figures()
    )


def _repair_and_distil(
    context: StageContext[RivrConfig],
    supervision: Supervision,
    targets: Sequence[TrainingView],
    others: Sequence[Selection],
    repairing: RepairContext,
    g0: SceneViewer,
) -> tuple[list[Selection], list[SceneFolder], SceneViewer]:
    """Run every round along the trajectory, group by group.

    A round that accepts no candidate is the last one. Its training also gets the steps of the remaining
    rounds. Returns the rows of all frames (first ``others``, the rows of frames that no round repairs), the
    folders of the trainings, and the last scene.
    """
    from cleargs.rivr.distillation import distil
    from cleargs.rivr.rounds import pseudo_view, run_round
    from cleargs.rivr.tables import kept_raw, repaired_share
    from cleargs.rivr.targets import trajectory_groups

    config, reporter, g0_config = context.config, context.reporter, context.settings["g0"]
    frames = len(supervision.real)
    length = config.distil.applied_to(g0_config, frames).length
    groups = trajectory_groups(targets, config.group, length)
    rows = list(others)
    trainings: list[SceneFolder] = []
    current = g0
    for number in range(1, config.rounds + 1):
        steps = done = 0
        taken = False
        for place, group in enumerate(groups):
            label = f"round {number}" + (f", group {place + 1} of {len(groups)}" if len(groups) > 1 else "")
            found = run_round(
                number, group.targets, current, repairing, context.out, reporter, label=f"{label}: candidates"
            )
            rows += found
            kept = kept_raw(rows)
            repairs = [
                pseudo_view(supervision.views[row.frame_id], row, context.out)
                for row in rows
                if row.accepted and row.frame_id not in kept
            ]
            steps += group.steps
            taken = any(row.accepted for row in rows if row.round == number)
            left = (config.rounds - number) * length
            if place + 1 == len(groups) and not taken and left:
                steps += left
                reporter.info(
                    f"{label}: no candidate is taken; the {steps} steps left train without new ones"
                )
            # Nothing is trained without repairs and kept frames: the next group gets the steps.
            if not (repairs or kept) or not steps:
                continue
            current = distil(
                current,
                [*supervision.real, *repairs],
                config.distillation(g0_config, number, done, steps, frames),
                context.checkpoints / f"round_{number:02d}" / f"group_{place + 1:03d}",
                seed=(context.seed, Stream.RIVR, number, *([place] if place else [])),
                label=f"{label}: distilling",
                round=number,
                pseudo_share=config.distil.pseudo_share,
                pseudo_weight=config.distil.pseudo_weight,
                repaired=repaired_share(rows),
                reporter=reporter,
            )
            done, steps = done + steps, 0
            if trainings:
                trainings[-1].drop_state()
            trainings.append(current.files)
        if not taken:
            break
    return rows, trainings, current


def _unchanged(context: StageContext[RivrConfig], supervision: Supervision, g0: SceneViewer) -> StageResult:
    """Publish G0's scene unchanged."""
    from cleargs.rivr.summaries import RivrSummary
    from cleargs.rivr.tables import Selection, write_selection

    context.reporter.info("RIVR: no repairs are made: the scene of G0 stays as it is")
    rows = [Selection.not_tried(frame_id, "not tried: no repairs are made") for frame_id in supervision.views]
    write_selection(context.out / "selection.parquet", rows)
    g0.files.publish([], context.out, None)
    return StageResult(summary=RivrSummary(rounds=[], published="G0").figures())
