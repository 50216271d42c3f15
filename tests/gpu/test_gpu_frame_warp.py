"""The frame warp on the GPU kernels, compared with the CPU's, and within a training."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from helpers import splat_toy
from helpers.warp_oracle import ALL, BENT, SCALE, SMALL, constant_fields, placed, random_image, scenery
from torch import Tensor

from cleargs.formation import capture
from cleargs.formation.capture import CaptureFormation
from cleargs.formation.frame import FrameFormation
from cleargs.formation.motion import FrameMotion
from cleargs.formation.warp import Warp, displacement_fields, enough_samples, linear_curve, srgb_curve
from cleargs.progress import SilentReporter
from cleargs.splat.backend import backend_for
from cleargs.splat.config import FormationConfig, TrainConfig
from cleargs.splat.kernels.cuda import support
from cleargs.splat.kernels.warp_layout import CHANNELS, CURVE_LAST
from cleargs.splat.trainer import Trainer
from cleargs.splat.training import Trained
from cleargs.splat.training import run as run_training

Both = Callable[..., tuple[Any, Any]]


@pytest.fixture
def both(device: torch.device, monkeypatch: pytest.MonkeyPatch) -> Both:
    """Return a function that calls another with tensors on the device, then on the CPU's kernels."""

    def call(function: Callable[..., Any], *tensors: Tensor) -> tuple[Any, Any]:
        found = function(*(tensor.to(device) for tensor in tensors))
        with monkeypatch.context() as patch:
            patch.setattr(support, "on_gpu", lambda device: False)
            return found, function(*tensors)

    return call


@pytest.mark.parametrize("margin", [0, 4])
@pytest.mark.parametrize("motion", [ALL, BENT], ids=["straight", "curved"])
def test_the_fields_are_those_of_the_cpu(both: Both, motion: FrameMotion, margin: int) -> None:
    found, expected = both(
        lambda depth, alpha: displacement_fields(motion, SMALL, depth, alpha, margin, SCALE), *scenery(margin)
    )
    assert found.sweep.std() > 1.0 and (found.curve is None) == (motion is ALL)
    names = ["offset", "sweep", "radius"] + (["curve"] if motion is BENT else [])
    for mine, theirs in ((getattr(found, name), getattr(expected, name)) for name in names):
        # Up to 8 px after about ten float32 operations, whose last bits differ: at most 5e-7 observed.
        torch.testing.assert_close(mine.cpu(), theirs, rtol=0.0, atol=1e-5)
    assert enough_samples(found) == enough_samples(expected)


def test_the_order_of_the_sums_does_not_matter(device: torch.device, monkeypatch: pytest.MonkeyPatch) -> None:
    kernels = importlib.import_module("cleargs.splat.kernels.cuda.frame_warp")
    warp = Warp.of(placed(constant_fields(12, 14, 5.0, 9.0), device))
    light = random_image(12, 14).to(device)
    found = []
    for block in (64, 256):
        monkeypatch.setattr(kernels, "BLOCK", block)
        found.append(warp.transpose(light))
    assert torch.equal(*found)


@pytest.mark.filterwarnings("ignore:invalid value:RuntimeWarning")  # NumPy, of the interpreter
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_light_that_is_not_finite_is_not_hidden(value: float, device: torch.device) -> None:
    warp = Warp.of(placed(constant_fields(7, 8, 3.0, 1.0), device))
    light = random_image(7, 8).to(device)
    light[3, 4, 1] = value
    assert warp.transpose(light)[3, 4, 1].isnan()


@pytest.mark.parametrize("curve", [linear_curve, srgb_curve], ids=["to linear light", "to sRGB"])
@pytest.mark.parametrize(("stored", "channels"), [(3, 4), (4, 3)])
def test_curves_are_those_of_the_cpu(
    curve: Callable[[torch.device], Tensor], stored: int, channels: int, both: Both
) -> None:
    values = torch.linspace(-0.2, CURVE_LAST + 0.3, 50 * stored).reshape(5, 10, stored)

    def follow(image: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        backend = backend_for(image.device)
        out, slope = backend.through_curve(image, curve(image.device), channels)
        return out.cpu(), slope.cpu(), backend.times_slope(out, slope, CHANNELS).cpu()

    found, expected = both(follow, values)
    for mine, theirs in zip(found, expected, strict=True):
        # The same operations, which the CPU may fuse: at most the last bit differs.
        torch.testing.assert_close(mine, theirs, rtol=1e-6, atol=1e-6)
    assert not found[2][..., 3].any()


def test_a_training_through_the_warp_follows_the_cpu(
    device: torch.device, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """A blurred, a rolled and a defocused frame, rendered with a margin."""
    monkeypatch.setattr(splat_toy, "WIDTH", 14)
    monkeypatch.setattr(splat_toy, "HEIGHT", 10)
    # The motions are given: a search would decide near ties by the last bit.
    monkeypatch.setattr(capture, "fit_motion", lambda frame, *given, **options: frame)
    rng = np.random.default_rng(0)
    views = splat_toy.views([rng.integers(0, 256, (10, 14, 3), dtype=np.uint8) for _ in range(3)])
    depth = {"median_depth": 1.0}
    motions = {
        "blur": FrameMotion(blur=0.3 * ALL.blur, **depth),
        "skew": FrameMotion(skew=ALL.skew, **depth),
        "defocus": FrameMotion(disc_px=1.2, focus=1.4, **depth),
    }
    known = {
        index: FrameFormation(index, motion, model, residual=0.1, residual_without=0.2, displacement_px=3.0)
        for index, (model, motion) in enumerate(motions.items())
    }
    config = TrainConfig(steps=3, densify=False, coarse_share=0.0, lr_means=2e-3)

    def trained(where: str) -> Trained:
        formation = CaptureFormation(views, FormationConfig(start=0.0), known=known)
        assert [frame.model for frame in formation.frames.values()] == list(motions)
        trainer = Trainer(splat_toy.start(6), views, config, seed=(7,), formation=formation, device=where)
        return run_training(trainer, checkpoint=tmp_path / "state.safetensors", reporter=SilentReporter())

    on_gpu = trained(str(device))
    with monkeypatch.context() as patch:
        patch.setattr(support, "on_gpu", lambda device: False)
        on_cpu = trained("cpu")
    assert sorted(on_cpu.rows.column("frame_id").to_pylist()) == [0, 1, 2]
    for name in ("loss", "l1", "ssim", "psnr"):
        expected = on_cpu.rows.column(name).to_pylist()
        assert on_gpu.rows.column(name).to_pylist() == pytest.approx(expected, rel=1e-5), name
    # At most 1e-6 observed. On a GPU a gradient near 0 may change its sign, as in test_gpu_training.py.
    for name, tensor in on_cpu.scene.gaussians.tensors().items():
        error = (getattr(on_gpu.scene.gaussians, name) - tensor).abs()
        assert (error < 1e-4).double().mean() > 0.97, name
