"""Learning rates: factors for short trainings, and decay."""

from __future__ import annotations

import pytest

from cleargs.scene.config import G0Config
from cleargs.splat.config import TrainConfig
from cleargs.splat.schedule import INRIA_STEPS, Schedule, rate_factor
from cleargs.stages.config import RivrConfig, RoundsConfig
from cleargs.stages.consolidate import FinalDistilConfig

GROUPS = ("means", "log_scales", "rotations", "sh", "sh_rest", "logit_opacities")


def rates(config: TrainConfig, step: int) -> dict[str, float]:
    return Schedule(config).rates(step)._asdict()


def test_a_short_training_learns_faster() -> None:
    assert rate_factor(INRIA_STEPS) == 1.0 and rate_factor(2 * INRIA_STEPS) == 1.0
    assert rate_factor(INRIA_STEPS // 4) == pytest.approx(2.0)
    assert rate_factor(1) == rate_factor(100) == 6.0
    long, short = (rates(TrainConfig(steps=steps), 0) for steps in (INRIA_STEPS, INRIA_STEPS // 4))
    for name in GROUPS:
        factor = 1.0 if name == "logit_opacities" else 2.0
        assert short[name] == pytest.approx(factor * long[name]), name
    assert rates(TrainConfig(steps=100, rate_factor=1.0), 0) == pytest.approx(long)


def test_rates_decay_to_the_configured_fraction() -> None:
    config = TrainConfig(steps=1000)
    first, last = rates(config, 0), rates(config, 1000)
    for name in GROUPS:
        share = config.lr_means_final if name == "means" else config.lr_final
        assert last[name] == pytest.approx(share * first[name]), name
        assert rates(config, 500)[name] == pytest.approx(first[name] * share**0.5), name


def test_distillation_continues_the_schedule_of_g0() -> None:
    """G0, two rounds and the consolidation are parts of one schedule."""
    whole = TrainConfig(steps=950)
    g0, rivr = G0Config(steps=800), RivrConfig(distil=RoundsConfig(steps=50))
    parts = (
        g0,
        rivr.distillation(g0, 1, 0, 50, frames=16),
        rivr.distillation(g0, 2, 0, 50, frames=16),
        FinalDistilConfig(steps=50).applied_to(g0, 16),
    )
    assert [part.planned for part in parts] == [950] * 4
    assert [part.first for part in parts] == [0, 800, 850, 900]
    for part in parts:
        for step in (part.first, part.first + part.length - 1):
            assert rates(part, step) == pytest.approx(rates(whole, step))
