"""When a distilled scene is rejected."""

from __future__ import annotations

import math

from cleargs.rivr.harm import Fidelity, HarmConfig, Verdict, judge_harm


def verdict(psnr: float, score: float) -> Verdict:
    before = Fidelity((30.0, 20.0), (60.0, 70.0))
    after = Fidelity((30.0 + psnr, 20.0 + psnr), (60.0 + score, 70.0 + score))
    return judge_harm([3, 9], before, after, HarmConfig(psnr_margin=0.5, score_margin=1.0))


def test_small_losses_are_no_harm() -> None:
    assert verdict(-0.4, -0.9).harm is None
    assert verdict(+2.0, +5.0).harm is None


def test_either_figure_can_reject() -> None:
    psnr, score, both = verdict(-0.6, +5.0), verdict(+2.0, -1.5), verdict(-0.6, -1.5)
    assert psnr.harm is not None
    assert "PSNR fell by 0.60 dB" in psnr.harm
    assert score.harm is not None
    assert "primary score fell by 1.50" in score.harm
    assert both.harm is not None
    assert " and " in both.harm


def test_the_figures_are_means_over_the_frames() -> None:
    summary = verdict(-0.25, 1.0).summary()
    assert summary["frames"] == [3, 9]
    assert math.isclose(summary["psnr_before"], 25.0)
    assert math.isclose(summary["psnr_after"], 24.75)
    assert math.isclose(summary["score_after"], 66.0)
