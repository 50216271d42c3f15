"""Distillation: training of the scene on raw frames and repairs together."""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean
from typing import Literal

import cv2
import numpy as np
import pyarrow as pa
import torch
from torch import Tensor

from cleargs.capture.folders import spread
from cleargs.files import atomic_path
from cleargs.formation.capture import CaptureFormation
from cleargs.formation.deblur import deblur
from cleargs.formation.dust import without_dust
from cleargs.formation.exposure import read_exposure, write_exposure
from cleargs.formation.frame import FrameFormation
from cleargs.formation.look import Shot, Terms, fit_motion
from cleargs.formation.measured import MeasuredPath
from cleargs.formation.movement import TOLERANCE, read_movement, still_pixels, write_movement
from cleargs.formation.observed import (
    MAX_EVALUATED,
    FormedView,
    evaluate_views,
    pooled_unseen,
    render_observed,
)
from cleargs.formation.shutter import rolls
from cleargs.formation.table import read_formation, write_formation
from cleargs.media.image import to_float32
from cleargs.models.scorer import Scorer
from cleargs.parquet import read_table, write_table
from cleargs.progress import Reporter
from cleargs.rivr.candidates import hide_masked
from cleargs.rivr.harm import Fidelity, HarmCheck, HarmConfig, harm_of
from cleargs.rivr.targets import Supervision
from cleargs.splat.backend import backend_for, psnr, rasteriser_for
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
EXPOSURE, FORMATION, MOVEMENT = "exposure.parquet", "formation.parquet", "movement.parquet"
REJECTED = "rejected.ply"
CHECKPOINT = "checkpoint.safetensors"


@dataclass(frozen=True, eq=False)
class Deblurred:
    """A raw frame without its motion or defocus."""

    image: ImageF32
    """[H, W, 3] sRGB in [0, 1], at the frame's pose."""
    formation: FrameFormation
    """The formation that was undone."""


@dataclass(frozen=True, eq=False)
class Explained:
    """The training's explanation of a raw frame: the render after image formation."""

    image: ImageF32
    """The render as the frame's camera saw it, [H, W, 3] sRGB in [0, 1]."""
    formation: FrameFormation
    weight: float
    """The frame's weight at the end of the training: RVA's, or a higher one by its misfit."""


def observation(view: TrainingView) -> tuple[ImageF32, MaskBool | None]:
    """Return the raw frame O_t [H, W, 3], float32 sRGB in [0, 1], and its mask [H, W] (None: all count)."""
    pixels, mask = view.load()
    return to_float32(pixels), mask


class TrainedScene:
    """A scene on disk, ready to be rendered.

    ``folder`` has ``scene.ply``, ``exposure.parquet``, ``formation.parquet`` and ``movement.parquet``;
    StoreError is raised if one is missing or damaged.
    """

    def __init__(
        self, folder: Path, device: str = "cpu", measured: Mapping[int, MeasuredPath] | None = None
    ) -> None:
        """``measured`` are the motions of ingest, by frame_id, for trainings and looks at frames."""
        self.folder, self._motions = folder, measured or {}
        self._device = device
        self.scene = read_ply(folder / SCENE).to(device)
        self._written_exposure = read_exposure(folder / EXPOSURE)
        self.exposure = self._written_exposure if self._written_exposure.enabled else None
        """The colour affines of the frames; None if exposure compensation is off."""
        self.formations, self._weights = read_formation(folder / FORMATION)
        # A scene of an older version has no such table.
        self.moving = read_movement(folder / MOVEMENT) if (folder / MOVEMENT).is_file() else {}
        """frame_id -> mask of the cells of the frame in which something moves."""
        self._engine = rasteriser_for(device)

    def render(self, view: TrainingView) -> ImageF32:
        """Return R_t: the scene at a view, through the frame's exposure, [H, W, 3] sRGB in [0, 1]."""
        image: ImageF32 = render_observed(self.scene, view, self.exposure, engine=self._engine).cpu().numpy()
        return image

    def _render_observed(self, view: TrainingView) -> Tensor:
        """Return the scene as the camera of a raw frame saw it, [H, W, 3] sRGB in [0, 1]."""
        formation = self.formations.get(view.frame_id)
        return render_observed(self.scene, view, self.exposure, formation, engine=self._engine).cpu()

    def psnr_unseen(self, views: Sequence[TrainingView]) -> float | None:
        """Return the PSNR, dB, of the pixels that no training saw; None if there are none.

        At most `MAX_EVALUATED` of ``views``, evenly spread, are evaluated.
        """
        few, engine = spread(views, MAX_EVALUATED), self._engine
        fits = evaluate_views(
            self.scene, few, self.exposure, self.formations, moving=self.moving, engine=engine
        )
        return pooled_unseen(fits)

    def still(self, view: TrainingView, mask: MaskBool | None) -> MaskBool | None:
        """Return ``mask`` without the pixels in which something moves; None: all pixels count."""
        if view.frame_id not in self.moving:
            return mask
        pixels = still_pixels(self.moving[view.frame_id], view.camera.height, view.camera.width)
        return pixels if mask is None else pixels & mask

    def explained(self, view: TrainingView) -> Explained | None:
        """Return the training's explanation of a raw frame; None without a model of the frame."""
        formation = self.formations.get(view.frame_id)
        if formation is None or formation.model == "none":
            return None
        return Explained(self._render_observed(view).numpy(), formation, self._weights[view.frame_id])

    def deblur(self, view: TrainingView) -> Deblurred | None:
        """Return the raw frame without its motion or defocus; None if no model explains the frame.

        If the training has estimated the formation of the frame, that is used. Otherwise it is estimated
        here.
        """
        observed, mask = observation(view)
        affine = self._affine(view)
        found = self.formations.get(view.frame_id, FrameFormation(view.frame_id))
        if found.draws == 0:
            found = fit_motion(
                found,
                FormationConfig(),
                Shot(
                    view.camera,
                    affine,
                    torch.from_numpy(observed),
                    None if mask is None else torch.from_numpy(mask),
                    self._with_depth,
                ),
                Terms(
                    doubted=True,
                    shutter="rolls" if rolls(self.formations.values()) else "still",
                    measured=self._motions.get(view.frame_id),
                ),
            )
        if found.model == "none":
            return None
        formed = FormedView(view.camera, 1.0, affine=affine, formation=found)
        return Deblurred(_deblurred(formed, self._with_depth(formed.camera), observed, mask), found)

    def formed_layers(self, view: TrainingView, factor: float = 1.0) -> dict[str, ImageF32]:
        """Return two images of a frame at scale ``factor``: without its motion, and as the scene explains it.

        The layers are named as in an EXR, ``deblurred`` and ``explained``. Without a model of the frame there
        are none.
        """
        formation = self.formations.get(view.frame_id)
        if formation is None or formation.model == "none":
            return {}
        observed, mask = observation(view)
        camera = view.camera.scaled(factor)
        if factor < 1.0:
            size = camera.width, camera.height
            observed = np.asarray(cv2.resize(observed, size, interpolation=cv2.INTER_AREA))
            if mask is not None:
                mask = cv2.resize(mask.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0
        formed = FormedView(camera, 1.0, affine=self._affine(view), formation=formation, factor=factor)
        render = self._with_depth(formed.camera)
        explained = formed.forward(render).clamp(0.0, 1.0).cpu().numpy()
        return {"deblurred": _deblurred(formed, render, observed, mask), "explained": explained}

    def _affine(self, view: TrainingView) -> Tensor | None:
        if self.exposure is None:
            return None
        return torch.from_numpy(self.exposure.of(view.frame_id).astype(np.float32))

    def _with_depth(self, camera: Camera) -> Render:
        return self._engine.view(self.scene, camera, depth=True)

    def fidelity(
        self,
        controls: Sequence[TrainingView],
        scorer: Scorer,
        threads: int,
        before: TrainedScene | None = None,
    ) -> Fidelity | None:
        """Return the agreement of the scene with the control frames; None without any.

        Pixels that move do not count: those of the scene ``before``, to compare with, or else of this scene.
        For PSNR, the render has the motion of the frame, since a sharp scene is not wrong because raw frames
        are blurred and skewed by the camera's motion.
        """
        values, scores = [], []
        for view in controls:
            render, (observed, mask) = self.render(view), observation(view)
            mask = (before or self).still(view, mask)
            counted = None if mask is None else torch.from_numpy(mask)
            values.append(psnr(self._render_observed(view), torch.from_numpy(observed), counted))
            scores.append(scorer.score(hide_masked(render, observed, mask), threads=threads))
        return Fidelity(fmean(values), fmean(scores)) if controls else None

    def trained(
        self,
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
    ) -> TrainedScene:
        """Continue the training on raw and repaired views, with Adam's moments; return the scene after it.

        A finished training is read back. An interrupted one resumes from its checkpoint, which is deleted at
        the end.

        ``even`` draws each repair as often as each raw frame. Otherwise a share of ``pseudo_share`` times
        ``repaired`` of the steps draws a repair: a few repairs must not be drawn as often as all frames
        together.
        """
        folder.mkdir(parents=True, exist_ok=True)
        if not (folder / SCENE).exists():
            formation = CaptureFormation(
                views,
                config.formation,
                exposure=self.exposure,
                lr_exposure=config.lr_exposure,
                known=self.formations,
                moving=self.moving,
                tolerance=TOLERANCE if self.moving else 0.0,
                measured=self._motions,
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
            learned, moving = formation.exposure or self._written_exposure, formation.moving
            result = without_dust(result, views, learned, formation.frames, moving, self._device).trained
            write_table(folder / LOG, result.rows, TRAIN)
            save_state(folder / STATE, result.state)
            write_exposure(folder / EXPOSURE, learned)
            weights = {view.frame_id: view.weight for view in views if view.kind == "real"}
            write_formation(folder / FORMATION, formation, weights)
            write_movement(folder / MOVEMENT, moving)
            write_ply(folder / SCENE, result.scene)  # last: it marks the training as done
        (folder / CHECKPOINT).unlink(missing_ok=True)
        return TrainedScene(folder, self._device, self._motions)


def _deblurred(formed: FormedView, render: Render, observed: ImageF32, mask: MaskBool | None) -> ImageF32:
    """Return ``observed`` without its motion; ``render`` is the scene at the camera of ``formed``."""
    shown = render.image
    if formed.affine is not None:
        shown = backend_for(shown.device).apply_affine(shown, formed.affine)
    weight = np.ones(observed.shape[:2], np.float32) if mask is None else mask.astype(np.float32)
    return deblur(shown.clamp(0.0, 1.0).cpu().numpy(), observed, weight, formed.warp(render))


def check_harm(
    g0: TrainedScene,
    trained: TrainedScene,
    supervision: Supervision,
    scorer: Scorer,
    limits: HarmConfig,
    threads: int,
    *,
    repaired: bool,
) -> HarmCheck:
    """Compare ``trained`` with ``g0`` on the control frames.

    Without ``repaired`` views the scene was trained on raw frames only, as G0 was. No repair can have done
    harm then, so nothing is rendered or scored.
    """
    views = [supervision.views[frame_id] for frame_id in supervision.controls] if repaired else []
    before, after = g0.fidelity(views, scorer, threads), trained.fidelity(views, scorer, threads, g0)
    return harm_of(supervision.controls, before, after, limits)


def publish(scene: TrainedScene, trainings: Sequence[Path], out: Path, rejected: TrainedScene | None) -> None:
    """Copy the scene, byte for byte, into the stage folder ``out``, with the log of all trainings.

    A scene that did harm is stored next to it as ``rejected.ply``.
    """
    logs = [read_table(training / LOG, TRAIN) for training in trainings]
    write_table(out / LOG, pa.concat_tables(logs) if logs else TRAIN.empty_table(), TRAIN)
    for name in (EXPOSURE, FORMATION, MOVEMENT, STATE, SCENE):
        _copy(scene.folder / name, out / name)
    if rejected is not None:
        _copy(rejected.folder / SCENE, out / REJECTED)


def drop_state(training: Path) -> None:
    """Remove the state of a finished training (three scenes large). Only the last one is needed."""
    (training / STATE).unlink(missing_ok=True)


def _copy(source: Path, target: Path) -> None:
    with atomic_path(target) as temporary:
        shutil.copyfile(source, temporary)
