"""Densification and training on the GPU's kernels, compared with the CPU's."""

from __future__ import annotations

import importlib
import math
from typing import ClassVar

import numpy as np
import pytest
import torch
from helpers import splat_toy

from cleargs.errors import StageError
from cleargs.formation.capture import CaptureFormation
from cleargs.formation.exposure import Exposure
from cleargs.progress import SilentReporter
from cleargs.scene.measure import evaluate_views
from cleargs.splat import densification
from cleargs.splat.config import FormationConfig, TrainConfig
from cleargs.splat.gaussians import Gaussians
from cleargs.splat.state import load_state
from cleargs.splat.trainer import Trainer
from cleargs.splat.training import run as run_training
from cleargs.splat.types import Moments
from cleargs.splat.views import ImageCache


@pytest.fixture
def densify(device):
    """The module, imported late, since it imports Triton."""
    return importlib.import_module("cleargs.splat.kernels.cuda.densify")


def crowd(count, device):
    made = splat_toy.gaussians(count)
    made.logit_opacities[:] = torch.linspace(-8.0, 3.0, count)
    return made.to(device)


def test_a_refinement_is_that_of_the_cpu(device, densify):
    """Two Gaussians have all of the error. There is a place for each of their halves: nothing is drawn."""
    gaussians = crowd(40, device)
    dead = int((gaussians.logit_opacities.sigmoid() <= 0.01).sum())
    assert dead == 13  # 2, 4, and of 8 all but one, which is new, as 16 more are
    errors = torch.zeros(40, device=device)
    errors[[20, 33]] = 2.0
    first, second = (
        {name: torch.ones_like(tensor) for name, tensor in gaussians.tensors().items()} for _ in range(2)
    )
    arrays = {name: tensor.cpu().numpy().copy() for name, tensor in gaussians.tensors().items()}
    running = [{name: np.ones_like(array) for name, array in arrays.items()}]
    settings = {"rate": 0.5, "budget": 57, "min_opacity": 0.01}
    grown, moments = densify.refine(gaussians, Moments(first, second), errors=errors, seed=(1,), **settings)
    reset = moments.first
    expected, (emptied,) = densification.refine(
        arrays, running, errors=errors.double().cpu().numpy(), rng=np.random.default_rng(1), **settings
    )
    assert grown.num == len(expected["means"]) == 57
    order = np.argsort(grown.means[:, 0].cpu().numpy()), np.argsort(expected["means"][:, 0])
    for name, tensor in grown.tensors().items():
        # float32 on both sides, except for the opacities.
        np.testing.assert_allclose(
            tensor.cpu().numpy()[order[0]], expected[name][order[1]], rtol=1e-5, atol=1e-6
        )
        assert np.array_equal(reset[name].cpu().numpy()[order[0]], emptied[name][order[1]])


def test_a_refinement_repeats_itself_and_keeps_to_the_budget(device, densify):
    settings = {"rate": 0.5, "budget": 55, "min_opacity": 0.005, "seed": (5,)}
    errors = torch.linspace(0.0, 1.0, 40, device=device)
    once, _ = densify.refine(crowd(40, device), Moments({}, {}), errors=errors, **settings)
    again, _ = densify.refine(crowd(40, device), Moments({}, {}), errors=errors, **settings)
    assert once.num == 55
    assert all(
        torch.equal(a, b) for a, b in zip(once.tensors().values(), again.tensors().values(), strict=True)
    )


def test_noise_has_the_covariance_and_spares_the_opaque(device, densify):
    count = 6000
    one = splat_toy.gaussians(1)
    gaussians = Gaussians(
        *(tensor.repeat(count, *[1] * (tensor.ndim - 1)) for tensor in one.tensors().values())
    )
    gaussians.logit_opacities[:] = -9.0
    gaussians.logit_opacities[:10] = 2.0
    gaussians = gaussians.to(device)
    start = gaussians.means.clone()
    densify.add_position_noise(gaussians, amount=2.0, min_opacity=0.005, seed=(11,))
    offsets = (gaussians.means - start).double().cpu()
    assert not offsets[:10].any()
    rotation = densification.rotation_matrices(one.rotations.numpy())[0].astype(np.float64)
    covariance = rotation @ np.diag(np.exp(2.0 * one.log_scales[0].double().numpy())) @ rotation.T
    # offset = 2 fade Σ draw, so its covariance is 4 fade² Σ². A sample gives its entries to a few per cent.
    fade = 1.0 / (1.0 + math.exp(-100.0 * (0.005 - 1.0 / (1.0 + math.exp(9.0)))))
    expected = 4.0 * fade**2 * covariance @ covariance
    measured = (offsets[10:].T @ offsets[10:] / (count - 10)).numpy()
    assert np.abs(measured - expected).max() < 0.06 * np.abs(expected).max()
    assert np.abs(offsets[10:].mean(dim=0).numpy()).max() < 0.05 * math.sqrt(np.abs(expected).max())


class FastGrowth(TrainConfig):
    growth: ClassVar[float] = 0.3


CONFIG = FastGrowth(
    steps=5,
    refine_every=2 / 5,
    refine_start=0.1,
    budget=14,
    checkpoint_interval=3,
    sh_every=2 / 5,
    coarse_share=0.4,
    lr_means=2e-3,
)


@pytest.fixture
def toy(monkeypatch):
    """Return three views of random images of 18 x 8 px, which have two tiles."""
    monkeypatch.setattr(splat_toy, "WIDTH", 18)
    monkeypatch.setattr(splat_toy, "HEIGHT", 8)
    rng = np.random.default_rng(0)
    pictures = [rng.integers(0, 256, (8, 18, 3), dtype=np.uint8) for _ in range(3)]
    return splat_toy.views(pictures, weights=[1.0, 0.5, 0.25])


def trained_on(device, views, folder, *, config=CONFIG, formation=None):
    scene = splat_toy.start(12, sh_degree=1)
    trainer = Trainer(scene, views, config, seed=(7,), formation=formation, device=str(device))
    return run_training(trainer, checkpoint=folder / "state.safetensors", reporter=SilentReporter())


def test_training_repeats_itself_and_resumes_to_the_same_bits(toy, device, tmp_path):
    def formation():
        identity = Exposure.identity([view.frame_id for view in toy])
        config = FormationConfig(start=0.5, every=2)
        return CaptureFormation(toy, config, exposure=identity, lr_exposure=CONFIG.lr_exposure)

    learned = formation()
    whole = trained_on(device, toy, tmp_path, formation=learned)
    assert whole.scene.gaussians.num == 14
    assert whole.scene.gaussians.device.type == "cpu"
    assert learned.exposure is not None
    assert learned.exposure.enabled
    rows = whole.rows.to_pydict()
    assert rows["step"] == [1, 2, 3, 4, 5]
    assert rows["width"] == [9, 9, 18, 18, 18]
    assert all(0.0 < loss < 1.0 for loss in rows["loss"])
    assert all(0.0 < value < 50.0 for value in rows["psnr"])
    # The checkpoint of step 3 is still there: resuming from it does steps 4 and 5 again.
    saved = load_state(tmp_path / "state.safetensors", SilentReporter())
    assert saved is not None
    assert int(saved["step"]) == 3
    resumed = trained_on(device, toy, tmp_path, formation=formation())
    assert resumed.rows.equals(whole.rows)
    for name, tensor in whole.state.items():
        assert torch.equal(tensor, resumed.state[name]), name


def test_training_follows_the_cpu(toy, device, tmp_path, monkeypatch):
    """Without densification, which draws other random numbers, both back ends take the same steps."""
    config = CONFIG.model_copy(update={"densify": "off", "steps": 3})
    on_gpu = trained_on(device, toy, tmp_path / "gpu", config=config)
    from cleargs.splat.kernels.cuda import support

    monkeypatch.setattr(support, "on_gpu", lambda device: False)
    on_cpu = trained_on("cpu", toy, tmp_path / "cpu", config=config)
    assert on_gpu.rows.column("frame_id").equals(on_cpu.rows.column("frame_id"))
    for name in ("loss", "l1", "ssim", "psnr"):
        expected = on_cpu.rows.column(name).to_pylist()
        assert on_gpu.rows.column(name).to_pylist() == pytest.approx(expected, rel=1e-4), name
    # Adam divides by the root of the second moment: a gradient near 0 may change its sign. Few do.
    for name, expected in on_cpu.scene.gaussians.tensors().items():
        error = (getattr(on_gpu.scene.gaussians, name) - expected).abs()
        assert (error < 1e-4).double().mean() > 0.97, name


def test_evaluation_on_the_device(toy, device):
    scene = splat_toy.start(8)
    fits = evaluate_views(scene.to(device), toy)
    cache = ImageCache(0, device)
    target, _ = cache.get(toy[1])
    assert target.device.type == device.type
    assert torch.equal(target.cpu(), torch.from_numpy(toy[1].load()[0] / np.float32(255.0)))
    assert all(5.0 < fit.psnr < 20.0 for fit in fits)


def test_a_loss_that_is_not_finite_stops_the_training(toy, device):
    trainer = Trainer(splat_toy.start(6), toy, CONFIG, seed=(1,), device=str(device))
    trainer.scene.gaussians.sh[2] = 1e38
    with pytest.raises(StageError, match="not finite"):
        for _ in range(2):
            trainer.step()
        trainer.rows(0)


def test_a_parameter_that_is_not_finite_is_named(toy, device):
    trainer = Trainer(splat_toy.start(6), toy, CONFIG, seed=(1,), device=str(device))
    trainer.check_finite()
    trainer.scene.gaussians.sh[2, 0, 1] = math.nan
    with pytest.raises(StageError, match="sh is not finite in 1 of 6 Gaussians at step 0"):
        trainer.check_finite()
