"""Adaptive density control: who is cloned, split and removed; resuming; choosing it by a setting."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from splat_toy import WIDTH, camera, gaussians, images, start, views

from cleargs.errors import ConfigError
from cleargs.pipeline.config import load_config
from cleargs.pipeline.dag import installed
from cleargs.progress import SilentReporter
from cleargs.splat.camera import Camera
from cleargs.splat.config import AdaptiveConfig, TrainConfig
from cleargs.splat.engine import Engine
from cleargs.splat.gaussians import Gaussians
from cleargs.splat.render import render
from cleargs.splat.strategy.adaptive import AdaptiveDensityControl, densify, lower_opacities, prune
from cleargs.splat.strategy.mcmc import sigmoid
from cleargs.splat.trainer import Trainer, train

CONFIG = TrainConfig(
    steps=40,
    strategy="adaptive",
    adaptive=AdaptiveConfig(grad=5e-5, reset=0.5),  # more are copied than faint ones removed
    refine_every=5 / 40,
    refine_start=0.1,
    budget=90,
    checkpoint_interval=7,
    opacity_reg=0.0,
    scale_reg=0.0,
)


def arrays(scales: list[float]) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    count = len(scales)
    made = {
        "means": rng.standard_normal((count, 3)),
        "log_scales": np.log(np.tile(np.array(scales)[:, None], 3)),
        "rotations": rng.standard_normal((count, 4)),
        "logit_opacities": np.full(count, 1.0),
        "sh": rng.standard_normal((count, 1, 3)),
    }
    return {name: array.astype(np.float32) for name, array in made.items()}


def test_the_gradient_on_the_screen_is_that_of_a_shift_of_the_principal_point() -> None:
    """Moving the principal point moves every projected mean alike, and hardly anything else."""
    scene = gaussians(20, seed=1)
    at, shift = camera(0.3), 0.1
    engine = Engine()
    # A ramp, so that the Gaussians pull the same way: random signs would leave little but noise of the sum.
    down, across = torch.linspace(0, 1, at.height)[:, None], torch.linspace(0, 1, at.width)[None, :]
    up = (across + 2.0 * down)[..., None].repeat(1, 1, 3).contiguous()
    engine.forward(scene, at)
    engine.backward(up)
    measured = engine.screen_gradients().double().sum(0)
    assert (engine.screen_gradients()[~engine.visible] == 0).all() and engine.visible.any()
    doubles = Gaussians(**{name: tensor.double() for name, tensor in scene.tensors().items()})

    def loss(dx: float, dy: float) -> float:
        moved = Camera(at.width, at.height, at.fx, at.fy, at.cx + dx, at.cy + dy, at.world_to_camera)
        return float((render(doubles, moved).image * up).sum())

    expected = torch.tensor([loss(shift, 0) - loss(-shift, 0), loss(0, shift) - loss(0, -shift)]) / (
        2 * shift
    )
    assert expected.abs().min() > 3.0
    # What pixels gain and lose at the cut-offs meanwhile: 1.1 % of the gradient.
    assert (measured - expected).norm() < 0.03 * expected.norm()


def test_small_ones_are_cloned_and_large_ones_split() -> None:
    made = arrays([0.005, 0.005, 0.1, 0.1])
    moments = [{name: np.ones_like(array) for name, array in made.items()}]
    pull = np.float32([1.0, 0.0, 1.0, 0.0])
    rng = np.random.default_rng(0)
    grown, (moment,) = densify(made, moments, pull, grad=0.5, dense=0.01, budget=100, rng=rng)
    assert len(grown["means"]) == 6
    for name in grown:  # 0, 1 and 3 stay; then the clone of 0; then the halves of 2
        assert np.array_equal(grown[name][:3], made[name][[0, 1, 3]])
        assert np.array_equal(grown[name][3], made[name][0])
        assert (moment[name][:3] == 1).all() and (moment[name][3:] == 0).all()
    halves = grown["means"][4:]
    assert np.allclose(np.exp(grown["log_scales"][4:]), 0.1 / 1.6, rtol=1e-5)
    distance = np.linalg.norm(halves - made["means"][2], axis=1)
    assert (distance > 0).all() and (distance < 0.6).all()  # drawn at a standard deviation of 0.1
    assert not np.array_equal(halves[0], halves[1])


@pytest.mark.parametrize(("budget", "expected"), [(3, 4), (4, 4), (5, 5), (50, 7)])
def test_the_strongest_pulled_come_first_within_the_budget(budget: int, expected: int) -> None:
    made = arrays([0.005] * 4)
    pull = np.float32([0.6, 0.9, 0.7, 0.1])
    rng = np.random.default_rng(0)
    grown, _ = densify(made, [], pull, grad=0.5, dense=0.01, budget=budget, rng=rng)
    assert len(grown["means"]) == expected
    if expected == 5:
        assert np.array_equal(grown["means"][4], made["means"][1])


def test_faint_and_large_ones_go_but_never_all() -> None:
    made = arrays([0.01, 0.01, 0.5])
    made["logit_opacities"][1] = -9.0
    kept, (moment,) = prune(made, [made], min_opacity=0.005, large=0.1)
    assert np.array_equal(kept["means"], made["means"][:1]) and len(moment["sh"]) == 1
    nothing_left, _ = prune(made, [], min_opacity=0.99, large=0.1)
    assert len(nothing_left["means"]) == 3


def test_opacities_are_lowered_to_the_limit_at_most() -> None:
    made = arrays([0.01, 0.01])
    made["logit_opacities"][1] = -9.0
    moments = [{"logit_opacities": np.ones(2, np.float32)}]
    lower_opacities(made, moments, 0.01)
    assert sigmoid(made["logit_opacities"])[0] == pytest.approx(0.01, rel=1e-5)
    assert made["logit_opacities"][1] == -9.0 and (moments[0]["logit_opacities"] == 0).all()


def test_a_training_grows_and_resumes_to_the_same_bits(tmp_path: Path) -> None:
    pictures = images(gaussians(), 6)
    whole = train(
        start(), views(pictures), CONFIG, seed=(7,), checkpoint=tmp_path / "a", reporter=SilentReporter()
    )
    assert 60 < whole.scene.gaussians.num <= 90
    first = Trainer(start(), views(pictures), CONFIG, seed=(7,))
    while first.done < 12:  # between two refinements: the gradients so far count
        first.step()
    state = {name: tensor.clone() for name, tensor in first.state().items()}
    assert "strategy.pull" in state
    second = Trainer(start(), views(pictures), CONFIG, seed=(7,))
    second.restore(state)
    while second.done < CONFIG.steps:
        second.step()
    for name, tensor in second.scene.gaussians.tensors().items():
        assert torch.equal(tensor, whole.scene.gaussians.tensors()[name]), name


def test_an_unknown_strategy_is_refused_with_a_near_name() -> None:
    assert load_config(installed(), "default", ["g0.strategy=adaptive"])
    with pytest.raises(ConfigError, match=r"g0\.strategy = 'adaptiv' cannot be used") as caught:
        load_config(installed(), "default", ["g0.strategy=adaptiv"])
    assert caught.value.hint == "did you mean adaptive?"


def test_reduced_images_are_observed_through_their_own_camera(monkeypatch: pytest.MonkeyPatch) -> None:
    """Gradients are by the pixel of the render: with the full-size camera they would count twice."""
    seen = []
    monkeypatch.setattr(AdaptiveDensityControl, "observe", lambda self, engine, at: seen.append(at.width))
    config = CONFIG.model_copy(update={"coarse_share": 0.5, "coarse_factor": 0.5})
    trainer = Trainer(start(), views(images(gaussians(), 6)), config, seed=(7,))
    for _ in range(config.length):
        trainer.step()
    half = config.length // 2
    assert seen == [WIDTH // 2] * half + [WIDTH] * half
