"""Conditions for the rejection of a distilled scene."""

from __future__ import annotations

from cleargs.rivr.harm import Fidelity, HarmConfig, HarmVerdict, judge_harm


def verdict(psnr: float, score: float) -> HarmVerdict:
    before, after = Fidelity(25.0, 65.0), Fidelity(25.0 + psnr, 65.0 + score)
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


def test_a_verdict_has_the_figures_that_decided() -> None:
    assert verdict(-0.25, 1.0) == HarmVerdict([3, 9], 25.0, 24.75, 65.0, 66.0, harm=None)


def test_without_held_back_frames_there_is_no_harm() -> None:
    assert judge_harm([], None, None, HarmConfig()) == HarmVerdict([], None, None, None, None, harm=None)
