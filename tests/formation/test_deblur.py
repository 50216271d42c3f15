"""A frame image without what its camera did to it."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.observations import ALPHA, MEDIAN, Image, observe, picture, psnr, soft, twist, wall_fields

from cleargs.formation import deblur as module
from cleargs.formation.deblur import deblur
from cleargs.formation.motion import FrameMotion
from cleargs.formation.warp import Warp

MOTIONS = [
    FrameMotion(blur=twist(0, 0, 0, 2, 5, 0), median_depth=MEDIAN),
    FrameMotion(blur=twist(0, 0, 0, -8, 9, 4), median_depth=MEDIAN),
    FrameMotion(blur=twist(0, 0, 0, 1, 3, 0), skew=twist(0, 0, 0, 2, 6, 0), median_depth=MEDIAN),
    FrameMotion(disc_px=9.0, focus=1.6, median_depth=MEDIAN),
]


@pytest.fixture(scope="module")
def truth() -> Image:
    return picture()


def warp(motion: FrameMotion) -> Warp:
    return Warp.of(wall_fields(motion))


@pytest.mark.parametrize("motion", MOTIONS, ids=["turn", "long turn with roll", "both", "defocus"])
def test_undoing_it_is_worth_more_than_frame_or_render(truth: Image, motion: FrameMotion) -> None:
    observed, render = observe(truth, motion), soft(truth)
    image = deblur(render, observed, ALPHA, warp(motion))
    # Measured with the true motion: 0.5 to 3.6 dB above the better one.
    assert psnr(image, truth) > max(psnr(observed, truth), psnr(render, truth)) + 0.3


def test_masked_pixels_come_from_the_render(truth: Image) -> None:
    observed, render = observe(truth, MOTIONS[0]), soft(truth)
    weight = ALPHA.copy()
    weight[40:90, 60:120] = 0.0
    ruined = np.where(weight[..., None] > 0, observed, render)
    image = deblur(render, ruined, weight, warp(MOTIONS[0]))
    inner = np.s_[55:75, 75:105]  # farther from the border of the mask than the motion reaches
    np.testing.assert_allclose(image[inner], render[inner], atol=0.01)


def test_what_moved_by_itself_spoils_only_its_place(truth: Image) -> None:
    observed, render = observe(truth, MOTIONS[0]), soft(truth)
    visited = observed.copy()
    visited[60:100, 90:140] = [0.9, 0.1, 0.1]
    clean, spoilt = (deblur(render, image, ALPHA, warp(MOTIONS[0])) for image in (observed, visited))
    away = np.ones(ALPHA.shape, np.bool_)
    away[45:115, 75:155] = False
    assert np.abs(clean - spoilt)[away].mean() < 0.004


def test_more_steps_than_the_solver_takes_change_little(
    truth: Image, monkeypatch: pytest.MonkeyPatch
) -> None:
    observed = observe(truth, MOTIONS[0])
    usual = deblur(soft(truth), observed, ALPHA, warp(MOTIONS[0]))
    monkeypatch.setattr(module, "STEPS", 60)
    solved = deblur(soft(truth), observed, ALPHA, warp(MOTIONS[0]))
    assert np.abs(usual - solved).mean() < 1 / 255
