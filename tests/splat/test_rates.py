"""Learning rates: those of a long training, faster in a short one, and falling."""

from __future__ import annotations

import pytest
import torch

from cleargs.splat.config import DistilConfig, G0Config, TrainConfig
from cleargs.splat.rates import INRIA_STEPS, Rates, rate_factor

GROUPS = ("means", "log_scales", "rotations", "sh", "logit_opacities")


def rates(config: TrainConfig, step: int) -> dict[str, float]:
    found = Rates(config, coefficients=4).at(step)
    return {
        name: float(value.max() if isinstance(value, torch.Tensor) else value)
        for name, value in found.items()
    }


def test_a_short_training_learns_faster() -> None:
    assert rate_factor(INRIA_STEPS) == 1.0 and rate_factor(2 * INRIA_STEPS) == 1.0
    assert rate_factor(INRIA_STEPS // 4) == pytest.approx(2.0)
    assert rate_factor(1) == rate_factor(100) == 6.0
    long, short = (rates(G0Config(steps=steps), 0) for steps in (INRIA_STEPS, INRIA_STEPS // 4))
    for name in GROUPS:
        factor = 1.0 if name == "logit_opacities" else 2.0
        assert short[name] == pytest.approx(factor * long[name]), name
    assert rates(G0Config(steps=100, rate_factor=1.0), 0) == pytest.approx(long)


def test_rates_fall_to_the_share_that_is_asked_for() -> None:
    config = G0Config(steps=1000)
    first, last = rates(config, 0), rates(config, 1000)
    for name in GROUPS:
        share = config.lr_means_final if name == "means" else config.lr_final
        assert last[name] == pytest.approx(share * first[name]), name
        assert rates(config, 500)[name] == pytest.approx(first[name] * share**0.5), name


def test_a_distillation_keeps_the_rates_that_a_scene_ends_with() -> None:
    """A finished scene must not be shaken up by a few hundred steps."""
    config = DistilConfig(steps=200)
    first, last = rates(config, 0), rates(config, 200)
    assert first["means"] == pytest.approx(8e-5) and first["log_scales"] == pytest.approx(5e-3)
    assert all(first[name] == last[name] for name in GROUPS[1:])
