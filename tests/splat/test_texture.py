"""The term of the loss that compares texture: gradient, masks, schedule, and equal bits."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from helpers.splat_toy import gaussians, images, start, views

from cleargs.errors import InputError
from cleargs.models.lpips import load_lpips, weights_file
from cleargs.models.registry import model_dir
from cleargs.progress import SilentReporter
from cleargs.splat import texture, trainer
from cleargs.splat.config import TrainConfig
from cleargs.splat.schedule import TEXTURE_EVERY, TEXTURE_FROM, Schedule
from cleargs.splat.texture import WEIGHTS, TextureLoss, crop_of
from cleargs.splat.trainer import Trainer
from cleargs.splat.training import Trained
from cleargs.splat.training import run as run_training

CONFIG = TrainConfig(steps=40, budget=80, checkpoint_interval=1, sh_every=0.25, lr_means=2e-3, texture=0.4)


def pair(height: int = 24, width: int = 24) -> tuple[torch.Tensor, torch.Tensor]:
    """A smooth image and one with noise on it, [H, W, 3], away from 0 and 1."""
    draw = torch.Generator().manual_seed(4)
    ramp = torch.linspace(0.3, 0.7, width).expand(height, width)[..., None].repeat(1, 1, 3)
    return ramp, ramp + 0.2 * (torch.rand(height, width, 3, generator=draw) - 0.5)


def trained(folder: Path, config: TrainConfig = CONFIG, stop: int | None = None) -> Trained:
    """Train the toy scene; ``stop``: in two halves, by two trainers."""
    folder.mkdir()
    seen, checkpoint = views(images(gaussians(), 4)), folder / "state.safetensors"
    trainer = Trainer(start(sh_degree=1), seen, config, seed=(7,))
    if stop is not None:
        while trainer.done < stop:
            trainer.step()
        state, trainer = trainer.state(), Trainer(start(sh_degree=1), seen, config, seed=(7,))
        assert trainer.matches(state)
        trainer.restore({name: tensor.clone() for name, tensor in state.items()})
    return run_training(trainer, checkpoint=checkpoint, reporter=SilentReporter())


def parameters(result: Trained) -> dict[str, torch.Tensor]:
    return result.scene.gaussians.tensors()


def same(first: Trained, second: Trained) -> bool:
    return all(torch.equal(tensor, parameters(second)[name]) for name, tensor in parameters(first).items())


def test_gradient_is_that_of_finite_differences() -> None:
    """In float64, along random directions. Steps of 1e-6 would cross kinks of |x - y| and ReLU."""
    loss, (target, image) = TextureLoss("cpu"), pair()
    loss._layers = [(kernel.double(), bias.double()) for kernel, bias in loss._layers]
    target, image = target.double(), image.double()
    gradient = loss.gradient(image, target)
    draw = torch.Generator().manual_seed(5)
    for _ in range(5):
        way = torch.randn(image.shape, generator=draw, dtype=torch.float64)
        step = 1e-8 * way
        ahead, behind = loss.distance(image + step, target), loss.distance(image - step, target)
        slope = float(ahead - behind) / 2e-8
        assert slope == pytest.approx(float((gradient * way).sum()), rel=1e-5)  # measured: 5e-8


def test_distance_sees_texture_that_is_missing() -> None:
    """Missing texture counts more than a shift of the brightness with the same squared error."""
    loss, (smooth, textured) = TextureLoss("cpu"), pair()
    brighter = textured + (smooth - textured).square().mean().sqrt()
    assert float(loss.distance(textured, textured)) == 0.0
    # Measured: 0.98 and 0.09.
    assert float(loss.distance(smooth, textured)) > 3.0 * float(loss.distance(brighter, textured))


def test_hidden_pixels_have_no_influence() -> None:
    loss, (target, image) = TextureLoss("cpu"), pair()
    mask = torch.ones(image.shape[:2], dtype=torch.bool)
    mask[5:13, 8:16] = False
    changed = torch.where(mask[..., None], target, 0.1)
    gradient = loss.gradient(image, target, mask)
    assert torch.equal(gradient, loss.gradient(image, changed, mask))
    assert not gradient[~mask].any() and gradient[mask].any()


def test_crops_fit_and_follow_the_seed() -> None:
    for height, width, side in ((400, 600, 96), (136, 240, 40), (20, 50, 16)):
        crops = [crop_of((3,), step, height, width) for step in range(50)]
        for rows, columns in crops:
            assert rows.stop - rows.start == columns.stop - columns.start == side
            assert min(rows.start, columns.start) >= 0 and rows.stop <= height and columns.stop <= width
        assert crops == [crop_of((3,), step, height, width) for step in range(50)]
        assert len({columns.start for _, columns in crops}) > 10
        assert crops != [crop_of((4,), step, height, width) for step in range(50)]


def test_term_is_in_the_last_part_of_the_schedule() -> None:
    """Also if another training continues the schedule."""
    whole = Schedule(TrainConfig(steps=100))
    part = Schedule(TrainConfig(steps=50, begin=0.5))
    expected = [step for step in range(100) if step >= 100 * TEXTURE_FROM and step % TEXTURE_EVERY == 0]
    for schedule in (whole, part):
        assert [step for step in range(100) if schedule.sees_texture(step)] == expected


def test_gradient_has_the_same_bits_for_any_number_of_threads() -> None:
    """test_trainer.py compares whole trainings, whose last part has the term."""
    loss, (target, image), threads = TextureLoss("cpu"), pair(64, 64), torch.get_num_threads()
    try:
        gradients = []
        for count in (1, 2, 3):
            torch.set_num_threads(count)
            gradients.append(loss.gradient(image, target))
            assert torch.get_num_threads() == count
    finally:
        torch.set_num_threads(threads)
    assert all(torch.equal(gradients[0], other) for other in gradients[1:])


def test_same_bits_after_a_resume(tmp_path: Path) -> None:
    assert same(trained(tmp_path / "whole"), trained(tmp_path / "resumed", stop=33))


def test_weight_zero_is_training_without_the_term(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with_term = trained(tmp_path / "with")
    monkeypatch.setattr(trainer, "TextureLoss", None)  # must not be called
    without = trained(tmp_path / "without", CONFIG.model_copy(update={"texture": 0.0}))
    assert not same(with_term, without)
    assert with_term.rows["loss"][:20].equals(without.rows["loss"][:20])


def test_damaged_installation_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(texture, "WEIGHTS", tmp_path / "none.safetensors")
    with pytest.raises(InputError, match="cannot be read") as caught:
        trained(tmp_path / "run")
    assert "install ClearGS again" in caught.value.hint


def test_weights_are_those_of_lpips() -> None:
    """They are the first three layers of the VGG16 that LPIPS uses, in float16."""
    if not (model_dir() / weights_file("vgg")).is_file():
        pytest.skip("LPIPS is not installed")
    trunk = load_lpips("vgg").trunk
    layers = [layer for block in list(trunk)[:2] for layer in block if isinstance(layer, torch.nn.Conv2d)]
    for own, layer in zip(TextureLoss("cpu")._layers, layers[:3], strict=True):
        assert layer.bias is not None
        expected = layer.weight.half().float(), layer.bias.half().float()
        assert torch.equal(own[0], expected[0]) and torch.equal(own[1], expected[1])
    assert WEIGHTS.stat().st_size < 230_000
