"""Conditions for the rejection of a distilled scene."""

from __future__ import annotations

from cleargs.rivr.harm import Fidelity, HarmCheck, HarmConfig, compare_on_controls


def checked(psnr: float, score: float) -> HarmCheck:
    before, after = Fidelity(25.0, 65.0), Fidelity(25.0 + psnr, 65.0 + score)
    return compare_on_controls([3, 9], before, after, HarmConfig(psnr_margin=0.5, score_margin=1.0))


def test_small_losses_are_no_harm() -> None:
    assert checked(-0.4, -0.9).harm is None
    assert checked(+2.0, +5.0).harm is None


def test_either_figure_can_reject() -> None:
    psnr, score, both = checked(-0.6, +5.0), checked(+2.0, -1.5), checked(-0.6, -1.5)
    assert psnr.harm is not None
    assert "PSNR fell by 0.60 dB" in psnr.harm
    assert score.harm is not None
    assert "primary score fell by 1.50" in score.harm
    assert both.harm is not None
    assert " and " in both.harm


def test_a_check_has_the_figures_that_decided() -> None:
    assert checked(-0.25, 1.0) == HarmCheck([3, 9], 25.0, 24.75, 65.0, 66.0, harm=None)


def test_without_held_back_frames_there_is_no_harm() -> None:
    assert compare_on_controls([], None, None, HarmConfig()) == HarmCheck(
        [], None, None, None, None, harm=None
    )
