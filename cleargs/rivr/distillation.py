"""Joint distillation of raw frames and repairs into the scene, and what came of it."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean
from typing import Literal

import numpy as np
import pyarrow as pa
import torch
from torch import Tensor

from cleargs.files import atomic_path
from cleargs.formation.capture import CaptureFormation, rolls
from cleargs.formation.deblur import deblur
from cleargs.formation.exposure import apply_affine, read_exposure, write_exposure
from cleargs.formation.frame import FrameFormation, fit_motion
from cleargs.formation.observed import FormedView, evaluate_views, pooled_unseen, render_observed
from cleargs.formation.table import read_formation, write_formation
from cleargs.models.scorer import Scorer
from cleargs.parquet import read_table, write_table
from cleargs.progress import Reporter
from cleargs.rivr.candidates import hide_masked
from cleargs.rivr.harm import Fidelity
from cleargs.splat.backend import psnr, rasteriser_for
from cleargs.splat.camera import Camera
from cleargs.splat.config import FormationConfig, TrainConfig
from cleargs.splat.ply import read_ply, write_ply
from cleargs.splat.state import read_moments, save_state
from cleargs.splat.tables import TRAIN
from cleargs.splat.trainer import Trainer
from cleargs.splat.types import Render
from cleargs.splat.views import TrainingView
from cleargs.types import ImageF32, MaskBool

SCENE, STATE, LOG = "scene.ply", "state.safetensors", "train.parquet"
EXPOSURE, FORMATION = "exposure.parquet", "formation.parquet"
REJECTED = "rejected.ply"
CHECKPOINT = "checkpoint.safetensors"


@dataclass(frozen=True, eq=False)
class Deblurred:
    """A raw frame without what its camera did to it."""

    image: ImageF32
    """[H, W, 3] sRGB in [0, 1], at the frame's pose."""
    formation: FrameFormation
    """What was undone."""


@dataclass(frozen=True, eq=False)
class Explained:
    """A raw frame as the training explains it."""

    image: ImageF32
    """The render as the frame's camera saw it, [H, W, 3] sRGB in [0, 1]."""
    formation: FrameFormation
    weight: float
    """The frame's weight at the end of the training: RVA's, or what it has earned by being explained."""


def observation(view: TrainingView) -> tuple[ImageF32, MaskBool | None]:
    """O_t as float32 sRGB, and its mask."""
    pixels, mask = view.load()
    if pixels.dtype == np.uint8:
        return pixels.astype(np.float32) / np.float32(255.0), mask
    return pixels.astype(np.float32), mask


class TrainedScene:
    """A scene on disk (``scene.ply``, ``exposure.parquet`` and ``formation.parquet`` in ``folder``), ready to
    be rendered. Raises StoreError without one of them.
    """

    def __init__(self, folder: Path, device: str = "cpu") -> None:
        self.folder = folder
        self._device = device
        self.scene = read_ply(folder / SCENE).to(device)
        self._written_exposure = read_exposure(folder / EXPOSURE)
        self.exposure = self._written_exposure if self._written_exposure.enabled else None
        """The affines of the frames; None where compensation is off."""
        self.formations, self._weights = read_formation(folder / FORMATION)
        self._engine = rasteriser_for(device)

    def render(self, view: TrainingView) -> ImageF32:
        """R_t: the scene at a view, through the frame's exposure, [H, W, 3] sRGB in [0, 1]."""
        image: ImageF32 = render_observed(self.scene, view, self.exposure, engine=self._engine).cpu().numpy()
        return image

    def _render_observed(self, view: TrainingView) -> Tensor:
        """The scene as the camera of a raw frame saw it, [H, W, 3] sRGB in [0, 1]."""
        formation = self.formations.get(view.frame_id)
        return render_observed(self.scene, view, self.exposure, formation, engine=self._engine).cpu()

    def psnr_unseen(self, views: Sequence[TrainingView]) -> float | None:
        """PSNR in dB of the pixels of ``views`` that no training saw; None where there are none."""
        return pooled_unseen(
            evaluate_views(self.scene, views, self.exposure, self.formations, engine=self._engine)
        )

    def explained(self, view: TrainingView) -> Explained | None:
        """What the training found of a raw frame's camera; None where that is nothing."""
        formation = self.formations.get(view.frame_id)
        if formation is None or formation.model == "none":
            return None
        return Explained(self._render_observed(view).numpy(), formation, self._weights[view.frame_id])

    def deblur(self, view: TrainingView) -> Deblurred | None:
        """The raw frame without what the camera did to it, found by comparing it with the scene; None where
        nothing explains the frame better than the render as it is.
        """
        observed, mask = observation(view)
        affine = (
            None
            if self.exposure is None
            else torch.from_numpy(self.exposure.of(view.frame_id).astype(np.float32))
        )
        found = fit_motion(
            self.formations.get(view.frame_id, FrameFormation(view.frame_id)),
            FormationConfig(),
            view.camera,
            affine,
            torch.from_numpy(observed),
            None if mask is None else torch.from_numpy(mask),
            self._with_depth,
            rolling=rolls(self.formations.values()),
        )
        if found.model == "none":
            return None
        formed = FormedView(view.camera, 1.0, affine=affine, formation=found)
        render = self._with_depth(formed.camera)
        warp = formed.warp(render)
        shown = render.image if affine is None else apply_affine(render.image, affine)
        weight = np.ones(observed.shape[:2], np.float32) if mask is None else mask.astype(np.float32)
        image = deblur(shown.clamp(0.0, 1.0).cpu().numpy(), observed, weight, warp)
        return Deblurred(image, found)

    def _with_depth(self, camera: Camera) -> Render:
        return self._engine.view(self.scene, camera, depth=True)

    def fidelity(self, holdout: Sequence[TrainingView], scorer: Scorer, threads: int) -> Fidelity | None:
        """How well the scene explains the held-back frames; None without any.

        Raw frames may be blurred and skewed by the camera's motion. A sharp scene is not to be blamed for
        that: what is compared with a frame is the render with that frame's motion.
        """
        values, scores = [], []
        for view in holdout:
            render, (observed, mask) = self.render(view), observation(view)
            counted = None if mask is None else torch.from_numpy(mask)
            values.append(psnr(self._render_observed(view), torch.from_numpy(observed), counted))
            scores.append(scorer.score(hide_masked(render, observed, mask), threads=threads))
        return Fidelity(fmean(values), fmean(scores)) if holdout else None

    def trained(
        self,
        views: Sequence[TrainingView],
        config: TrainConfig,
        folder: Path,
        *,
        seed: Sequence[int],
        label: str,
        round: int,
        pseudo_share: float | Literal["even"],
        pseudo_weight: float,
        repaired: float = 1.0,
        reporter: Reporter,
    ) -> TrainedScene:
        """This scene after training on, with Adam's moments, on raw and repaired views, kept in ``folder``.

        pseudo_share, pseudo_weight: share of the steps that draw a repair (even: each as often as any raw
        frame), and the factor on its loss.
        repaired: of the frames that were to be repaired, the share that has a repair. The turns of the others
        go to the raw frames: drawn as often as all of them, a few repairs would drown these.
        A training that is done already is read back; one that was cut off resumes from its checkpoint, which
        is deleted in the end.
        """
        folder.mkdir(parents=True, exist_ok=True)
        if not (folder / SCENE).exists():
            formation = CaptureFormation(
                views,
                config.formation,
                exposure=self.exposure,
                lr_exposure=config.lr_exposure,
                known=self.formations,
            )
            even = sum(view.kind == "pseudo" for view in views) / len(views)
            share = even if pseudo_share == "even" else pseudo_share * repaired
            trainer = Trainer(
                self.scene,
                views,
                config,
                seed=seed,
                formation=formation,
                moments=read_moments(self.folder / STATE, self.scene.gaussians),
                pseudo_share=share,
                pseudo_weight=pseudo_weight,
                device=self._device,
            )
            result = trainer.run(checkpoint=folder / CHECKPOINT, reporter=reporter, label=label, round=round)
            write_table(folder / LOG, result.rows, TRAIN)
            save_state(folder / STATE, result.state)
            write_exposure(folder / EXPOSURE, formation.exposure or self._written_exposure)
            weights = {view.frame_id: view.weight for view in views if view.kind == "real"}
            write_formation(folder / FORMATION, formation, weights)
            write_ply(folder / SCENE, result.scene)  # last: it says that the training is done
        (folder / CHECKPOINT).unlink(missing_ok=True)
        return TrainedScene(folder, self._device)


def publish(scene: TrainedScene, trainings: Sequence[Path], out: Path, rejected: TrainedScene | None) -> None:
    """Copy the scene, byte for byte, into the stage folder ``out``, with the log of all ``trainings`` (the
    folders they are kept in).

    A rejected scene lies beside it as ``rejected.ply``.
    """
    logs = [read_table(training / LOG, TRAIN) for training in trainings]
    write_table(out / LOG, pa.concat_tables(logs) if logs else TRAIN.empty_table(), TRAIN)
    for name in (EXPOSURE, FORMATION, STATE, SCENE):
        _copy(scene.folder / name, out / name)
    if rejected is not None:
        _copy(rejected.folder / SCENE, out / REJECTED)


def drop_state(training: Path) -> None:
    """Drop from the folder of a finished training what only the last one is asked for: its state, which is
    three times as large as the scene.
    """
    (training / STATE).unlink(missing_ok=True)


def _copy(source: Path, target: Path) -> None:
    with atomic_path(target) as temporary:
        shutil.copyfile(source, temporary)
