"""Limits of the GPU's rasteriser."""

from __future__ import annotations

import pytest
import torch
from helpers.splat_scenes import make_camera, make_gaussians

from cleargs.errors import StageError
from cleargs.splat.backend import rasteriser_for
from cleargs.splat.kernels import rasteriser
from cleargs.splat.kernels.cuda import support


def test_depth_gradient_needs_a_forward_with_depth(device):
    camera = make_camera(16, 16)
    engine = rasteriser_for(device)
    image = engine.forward(make_gaussians(camera, 4).to(device), camera).image
    with pytest.raises(ValueError, match="depth"):
        engine.backward(image, None, image[..., 0])


def test_too_many_pairs_is_an_error(device, monkeypatch):
    monkeypatch.setattr(rasteriser, "MAX_PAIRS", 10)
    camera = make_camera(36, 27)
    with pytest.raises(StageError, match="pairs"):
        rasteriser_for(device).forward(make_gaussians(camera, 20).to(device), camera)


def test_pairs_that_do_not_fit_are_refused_before_they_are_made(device, monkeypatch):
    monkeypatch.setattr(rasteriser, "UNCHECKED_BYTES", 0)
    camera = make_camera(20, 18)
    gaussians = make_gaussians(camera, 12).to(device)
    engine = rasteriser_for(device)
    monkeypatch.setattr(rasteriser, "available_memory", lambda device: 100)
    with pytest.raises(StageError, match=r"12 Gaussians give .* more than fit"):
        engine.forward(gaussians.select(torch.arange(12, device=device)), camera)
    monkeypatch.undo()
    assert support.available_memory(device) > 2**20


def test_exhausted_memory_names_the_settings():
    with pytest.raises(StageError, match="memory") as caught, support.memory_errors():
        raise torch.cuda.OutOfMemoryError("CUDA out of memory. Tried to allocate 20.00 GiB.\nMore.")
    assert "budget" in caught.value.hint
