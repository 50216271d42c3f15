"""Distillation: training of the scene on frame images and repairs together, and the check of its result."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from statistics import fmean
from typing import Literal

import torch

from cleargs.formation.capture import CaptureFormation
from cleargs.formation.movement import TOLERANCE
from cleargs.models.scorer import Scorer
from cleargs.progress import Reporter
from cleargs.rivr.candidates import hide_masked
from cleargs.rivr.harm import Fidelity, HarmCheck, HarmConfig, compare_on_controls
from cleargs.rivr.targets import Supervision
from cleargs.scene.folder import SceneFolder
from cleargs.scene.training import train_into
from cleargs.scene.viewer import SceneViewer, observed_image
from cleargs.splat.backend import psnr
from cleargs.splat.config import OFF, TrainConfig
from cleargs.splat.views import TrainingView

CHECKPOINT = "checkpoint.safetensors"


def distil(
    start: SceneViewer,
    views: Sequence[TrainingView],
    config: TrainConfig,  # with the part of the schedule
    folder: Path,
    *,
    seed: Sequence[int],
    label: str,
    round: int,
    pseudo_share: float | Literal["even"],
    pseudo_weight: float,  # factor on the loss of a repair
    repaired: float = 1.0,  # share of the frames that have a repair
    reporter: Reporter,
) -> SceneViewer:
    """Continue the training on frame images and repairs, with Adam's moments; return the scene after it.

    A finished training is read back. An interrupted one resumes from its checkpoint, which is deleted at the
    end.

    ``even`` draws each repair as often as each frame image. Otherwise a share of ``pseudo_share`` times
    ``repaired`` of the steps draws a repair: a few repairs must not be drawn as often as all frames together.
    """
    folder.mkdir(parents=True, exist_ok=True)
    if not SceneFolder(folder).finished:
        formation = CaptureFormation(
            views,
            config.formation,
            exposure=start.exposure,
            lr_exposure=config.lr_exposure,
            known=start.formations,
            moving=start.moving,
            tolerance=TOLERANCE if start.moving else 0.0,
            measured=start.motions,
        )
        even = sum(view.kind == "pseudo" for view in views) / len(views)
        train_into(
            folder,
            start.scene,
            views,
            config,
            formation,
            exposure=start.written_exposure,
            checkpoint=folder / CHECKPOINT,
            reporter=reporter,
            label=label,
            device=start.device,
            round=round,
            dust=config.densify != OFF,  # without new Gaussians there is little since the first training
            seed=seed,
            moments=start.files.moments(start.scene.gaussians),
            pseudo_share=even if pseudo_share == "even" else pseudo_share * repaired,
            pseudo_weight=pseudo_weight,
        )
    (folder / CHECKPOINT).unlink(missing_ok=True)
    return SceneViewer(folder, start.device, start.motions)


def fidelity(
    scene: SceneViewer,
    controls: Sequence[TrainingView],
    scorer: Scorer,
    threads: int,
    before: SceneViewer | None = None,
) -> Fidelity | None:
    """Return the agreement of the scene with the control frames; None without any.

    Pixels that move do not count: those of the scene ``before``, to compare with, or else of this scene. For
    PSNR, the render has the motion of the frame, since a sharp scene is not wrong because frame images are
    blurred and skewed by the camera's motion.
    """
    values, scores = [], []
    for view in controls:
        render, (observed, mask) = scene.render(view), observed_image(view)
        mask = (before or scene).static_mask(view, mask)
        counted = None if mask is None else torch.from_numpy(mask)
        values.append(psnr(scene.formed(view), torch.from_numpy(observed), counted))
        scores.append(scorer.score(hide_masked(render, observed, mask), threads=threads))
    return Fidelity(fmean(values), fmean(scores)) if controls else None


def check_harm(
    g0: SceneViewer,
    trained: SceneViewer,
    supervision: Supervision,
    scorer: Scorer,
    limits: HarmConfig,
    threads: int,
    *,
    repaired: bool,
) -> HarmCheck:
    """Compare ``trained`` with ``g0`` on the control frames.

    Without ``repaired`` views the scene was trained on frame images only, as G0 was. No repair can have done
    harm then, so nothing is rendered or scored.
    """
    views = [supervision.views[frame_id] for frame_id in supervision.controls] if repaired else []
    before, after = fidelity(g0, views, scorer, threads), fidelity(trained, views, scorer, threads, g0)
    return compare_on_controls(supervision.controls, before, after, limits)
