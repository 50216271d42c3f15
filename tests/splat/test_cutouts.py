"""A training on cut-outs leaves their empty pixels empty."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers import splat_toy

from cleargs.formation.capture import CaptureFormation
from cleargs.formation.exposure import Exposure
from cleargs.progress import SilentReporter
from cleargs.splat.backend import rasteriser_for
from cleargs.splat.config import FormationConfig, TrainConfig
from cleargs.splat.trainer import Trainer
from cleargs.splat.training import run as run_training


@pytest.mark.parametrize("exposed", [False, True])
def test_transparent_pixels_become_empty(tmp_path: Path, exposed: bool) -> None:
    engine, truth = rasteriser_for("cpu"), splat_toy.gaussians()
    truth = replace(truth, means=truth.means * 0.4, log_scales=truth.log_scales - 0.7)
    views = []
    for view in splat_toy.views(splat_toy.images(truth, 6)):
        image, alpha = (part.numpy().copy() for part in engine.forward(truth, view.camera)[:2])
        straight = np.rint(np.clip(image / np.maximum(alpha, 1e-3)[..., None], 0, 1) * 255).astype(np.uint8)
        levels = np.rint(alpha * 255).astype(np.uint8)
        load = splat_toy.keep(straight, levels > 127)
        views.append(replace(view, load=load, transparency=lambda levels=levels: levels))
    start = splat_toy.start(400)
    start.gaussians.means.mul_(2.0)  # a haze around the blobs
    formation = CaptureFormation(
        views,
        FormationConfig(),
        exposure=Exposure.identity([view.frame_id for view in views]) if exposed else None,
        lr_exposure=1e-3,
    )
    config = TrainConfig(steps=300, begin=0.0, end=1.0, budget=400)
    trainer = Trainer(start, views, config, seed=(0,), formation=formation)
    made = run_training(
        trainer, checkpoint=tmp_path / "c.safetensors", reporter=SilentReporter()
    ).scene.gaussians
    outside, inside = [], []
    for view in views:
        target = engine.forward(truth, view.camera).alpha.clone()
        alpha = engine.forward(made, view.camera).alpha.clone()
        outside.append(alpha[target < 0.004])
        inside.append(alpha[target > 0.97])
    assert sum(map(len, outside)) > 500
    # Observed: 0.014 and 0.84.
    assert float(torch.cat(outside).mean()) < 0.02 and float(torch.cat(inside).mean()) > 0.75
