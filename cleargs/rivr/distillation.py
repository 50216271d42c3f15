"""Joint distillation of raw frames and repairs into the scene, and what came of it."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
import torch
from numpy.typing import NDArray

from cleargs.files import atomic_path
from cleargs.models.scorer import Scorer
from cleargs.progress import Reporter
from cleargs.rivr.candidates import Image
from cleargs.rivr.harm import Fidelity
from cleargs.rivr.motion.undo import as_photographed
from cleargs.rivr.restoring import observation
from cleargs.rivr.selection import hide_masked
from cleargs.splat.compensation import Exposure, read_exposure, write_exposure
from cleargs.splat.config import DistilConfig
from cleargs.splat.engine import Engine
from cleargs.splat.losses import psnr
from cleargs.splat.ply import read_ply, write_ply
from cleargs.splat.state import save_state
from cleargs.splat.tables import TRAIN
from cleargs.splat.trainer import render_view, train
from cleargs.splat.views import View
from cleargs.tables import read_table, write_table

SCENE, EXPOSURE, STATE, LOG = "scene.ply", "exposure.parquet", "state.safetensors", "train.parquet"
REJECTED = "rejected.ply"
CHECKPOINT = "checkpoint.safetensors"

LEAST_COVERED = 0.5
"""Alpha from which a pixel has a depth."""
NEAREST = 0.05
"""Of the median depth: floaters before the lens lie nearer."""


class Snapshot:
    """A scene on disk (``scene.ply`` and ``exposure.parquet`` in ``folder``), ready to be rendered."""

    def __init__(self, folder: Path, device: str = "cpu") -> None:
        self.folder = folder
        self._device = device
        self.scene = read_ply(folder / SCENE).to(device)
        self._written_exposure = read_exposure(folder / EXPOSURE)
        self._engine = Engine(device)

    @property
    def exposure(self) -> Exposure | None:
        """The affines of the frames; None where compensation is off."""
        return self._written_exposure if self._written_exposure.enabled else None

    def render(self, view: View) -> Image:
        """R_t: the scene at a view, through the frame's exposure, [H, W, 3] sRGB in [0, 1]."""
        image: Image = render_view(self.scene, view, self.exposure, engine=self._engine).cpu().numpy()
        return image

    def depth(self, view: View) -> NDArray[np.float32]:
        """Mean depth along the optical axis, [H, W]; the median where the scene is empty or all too near."""
        rendered = self._engine.forward(
            self.scene.gaussians, view.camera, antialias=self.scene.antialias, depth=True
        )
        assert rendered.depth is not None
        covered, depth = rendered.alpha.cpu().numpy(), rendered.depth.cpu().numpy()
        mean = depth / np.maximum(covered, LEAST_COVERED)
        median = np.median(mean[covered > LEAST_COVERED]) if (covered > LEAST_COVERED).any() else 1.0
        usable = (covered > LEAST_COVERED) & (mean > NEAREST * median)
        return np.where(usable, mean, median).astype(np.float32)

    def fidelity(self, judges: Sequence[View], scorer: Scorer, threads: int) -> Fidelity:
        """How well the scene explains the held-back frames.

        Raw frames may be blurred and skewed by the camera's motion. A sharp scene is not to be blamed for
        that: what is compared with a frame is the render with that frame's motion.
        """
        values, scores = [], []
        for view in judges:
            render, (observed, mask) = self.render(view), observation(view)
            photographed = as_photographed(render, observed, mask, view.camera, self.depth(view))
            counted = None if mask is None else torch.from_numpy(mask)
            values.append(psnr(torch.from_numpy(photographed), torch.from_numpy(observed), counted))
            scores.append(scorer.score(hide_masked(render, observed, mask), threads=threads))
        return Fidelity(tuple(values), tuple(scores))

    def trained(
        self,
        views: Sequence[View],
        config: DistilConfig,
        folder: Path,
        *,
        seed: Sequence[int],
        label: str,
        round: int,
        repaired: float = 1.0,
        reporter: Reporter,
    ) -> Snapshot:
        """This scene after training with fresh Adam moments on raw and repaired views, kept in ``folder``.

        repaired: of the frames that were to be repaired, the share that has a repair. The turns of the others
        go to the raw frames: drawn as often as all of them, a few repairs would drown these.
        A training that is done already is read back; one that was cut off goes on from its checkpoint, which
        is deleted in the end.
        """
        folder.mkdir(parents=True, exist_ok=True)
        if not (folder / SCENE).exists():
            result = train(
                self.scene,
                views,
                config,
                seed=seed,
                exposure=self.exposure,
                pseudo_share=_pseudo_share(config, views, repaired),
                pseudo_weight=config.pseudo_weight,
                checkpoint=folder / CHECKPOINT,
                reporter=reporter,
                label=label,
                round=round,
                device=self._device,
            )
            write_table(folder / LOG, result.rows, TRAIN)
            save_state(folder / STATE, result.state)
            write_exposure(folder / EXPOSURE, result.exposure or self._written_exposure)
            write_ply(folder / SCENE, result.scene)  # last: it says that the training is done
        (folder / CHECKPOINT).unlink(missing_ok=True)
        return Snapshot(folder, self._device)


def publish(snapshot: Snapshot, trainings: Sequence[Path], out: Path, rejected: Snapshot | None) -> None:
    """Copy the scene, byte for byte, into the stage folder ``out``, with the log of all ``trainings`` (the
    folders they are kept in).

    A rejected scene lies beside it as ``rejected.ply``.
    """
    logs = [read_table(training / LOG, TRAIN) for training in trainings]
    write_table(out / LOG, pa.concat_tables(logs) if logs else TRAIN.empty_table(), TRAIN)
    for name in (EXPOSURE, STATE, SCENE):
        _copy(snapshot.folder / name, out / name)
    if rejected is not None:
        _copy(rejected.folder / SCENE, out / REJECTED)


def superseded(training: Path) -> None:
    """Drop from the folder of a finished training what only the last one is asked for: its state, which is
    three times as large as the scene."""
    (training / STATE).unlink(missing_ok=True)


def _pseudo_share(config: DistilConfig, views: Sequence[View], repaired: float) -> float:
    if isinstance(config.pseudo_share, str):  # even
        return sum(view.kind == "pseudo" for view in views) / len(views)
    return config.pseudo_share * repaired


def _copy(source: Path, target: Path) -> None:
    with atomic_path(target) as temporary:
        shutil.copyfile(source, temporary)
