"""The gates refuse repairs with a planted fault, and accept those that only remove blur."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from planted import FAULTS
from tiny_capture import Capture, Contrast, Sharpen, tiny_rivr, tried_rows, write_capture

from cleargs.media.colour import linear_from_srgb, srgb_from_linear
from cleargs.media.exr import read_exr
from cleargs.models import expert as expert_module
from cleargs.models import scorer as scorer_module
from cleargs.progress import SilentReporter
from cleargs.rivr.gates import GateConfig, colour_differences, rejection_reason, shifts
from cleargs.rivr.rounds import read_row
from cleargs.stages import rivr
from cleargs.types import ImageF32

HEIGHT, WIDTH = 180, 320
LIMITS = GateConfig()


@pytest.fixture(scope="module")
def sharp() -> ImageF32:
    """Small squares and discs of all colours, before a ground that changes from place to place."""
    rng = np.random.default_rng(0)
    ground = rng.uniform(0.1, 0.9, (3, 4, 3)).astype(np.float32)
    image = cv2.resize(ground, (WIDTH, HEIGHT), interpolation=cv2.INTER_LINEAR)
    for _ in range(1200):
        centre, colour = rng.integers(0, (WIDTH, HEIGHT)).tolist(), rng.uniform(0.1, 0.9, 3).tolist()
        if rng.random() < 0.5:
            cv2.circle(image, centre, int(rng.integers(1, 6)), colour, -1, cv2.LINE_AA)
        else:
            far = (np.array(centre) + rng.integers(-8, 9, 2)).tolist()
            cv2.rectangle(image, centre, far, colour, -1)
    return cv2.GaussianBlur(image, (0, 0), 0.5)


@pytest.fixture(scope="module")
def observed(sharp: ImageF32) -> ImageF32:
    """The scene through 5 px of horizontal motion, with noise."""
    linear = cv2.blur(sharp**2.2, (5, 1))
    noise = np.random.default_rng(1).normal(0.0, 0.01, sharp.shape)
    return np.clip(linear ** (1 / 2.2) + noise, 0.0, 1.0).astype(np.float32)


@pytest.fixture(scope="module")
def render(sharp: ImageF32) -> ImageF32:
    """The scene as Gaussians show it: soft, and smeared here and there."""
    soft = cv2.GaussianBlur(sharp, (0, 0), 1.5)
    soft[40:60, 100:160] = soft[40:60, 100:160].mean(axis=(0, 1))
    return soft


def test_a_perfect_repair_is_admitted(sharp: ImageF32, observed: ImageF32, render: ImageF32) -> None:
    assert rejection_reason(sharp, observed, render, LIMITS) is None
    # No block is nearer to its limit than a quarter.
    assert shifts(sharp, observed, render).max() < 0.15
    assert colour_differences(sharp, observed, render).max() < 0.01


def test_either_witness_suffices(sharp: ImageF32, observed: ImageF32, render: ImageF32) -> None:
    """A repair may be aligned with the frame image and not with the render, or the reverse."""
    off = np.roll(render, 4, axis=0)
    assert rejection_reason(sharp, observed, off, LIMITS) is None
    assert rejection_reason(np.roll(sharp, 4, axis=0), observed, off, LIMITS) is None
    assert rejection_reason(np.roll(sharp, 2, axis=0), observed, off, LIMITS) is not None


@pytest.mark.parametrize("pixels", [1, 2, 4])
def test_a_shift_is_measured(pixels: int, sharp: ImageF32) -> None:
    soft = cv2.GaussianBlur(sharp, (0, 0), 1.0)
    found = shifts(np.roll(sharp, -pixels, axis=0), soft, soft)
    # The parabola through a peak of this width is good to a fifth of a pixel.
    assert np.median(found) == pytest.approx(pixels, abs=0.2)


FOUND = {"shift 4 px": "out of place", **dict.fromkeys(["tint 16%", "half the contrast"], "off colour")}
"""Those of `FAULTS` that docs/experiments/rivr.md reports as always found -> the gate that finds them."""


@pytest.mark.parametrize("name", FOUND)
def test_gross_faults_are_found(name: str, sharp: ImageF32, observed: ImageF32, render: ImageF32) -> None:
    for seed in range(4):
        faulty = FAULTS[name](sharp, np.random.default_rng(seed))
        assert FOUND[name] in (rejection_reason(faulty, observed, render, LIMITS) or "")


def test_one_bad_block_shows_but_does_not_condemn_the_rest(
    sharp: ImageF32, observed: ImageF32, render: ImageF32
) -> None:
    strict = LIMITS.model_copy(update={"max_share": 0.0})
    for name in ("block shifted 4 px", "block tinted 16%"):
        faulty = FAULTS[name](sharp, np.random.default_rng(0))
        assert rejection_reason(faulty, observed, render, LIMITS) is None
        assert rejection_reason(faulty, observed, render, strict) is not None


def test_along_heavy_blur_the_place_is_uncertain(sharp: ImageF32, render: ImageF32) -> None:
    """A shift by 2 px along 15 px of motion explains the frame as well; across the motion it does not."""
    observed = cv2.blur(sharp, (15, 1))
    assert rejection_reason(np.roll(sharp, 2, axis=1), observed, render, LIMITS) is None
    assert rejection_reason(np.roll(sharp, 2, axis=0), observed, render, LIMITS) is not None


def test_a_lone_edge_has_no_place_along_itself() -> None:
    """The highest point of its correlation is chance."""
    edge = np.where(np.arange(WIDTH)[None, :, None] > 150, 0.8, 0.2) * np.ones((HEIGHT, 1, 3))
    noise = np.random.default_rng(2).normal(0.0, 0.01, (2, *edge.shape))
    repair, frame = (cv2.GaussianBlur(edge, (0, 0), 1.0) + noise).astype(np.float32)
    assert not shifts(repair, frame, frame).any()


def test_flat_images_agree() -> None:
    """No texture, nothing to align; no division by zero either."""
    flat = np.full((70, 90, 3), 0.4, np.float32)
    assert rejection_reason(flat, flat, flat, LIMITS) is None
    assert rejection_reason(flat + np.float32(0.1), flat, flat, LIMITS) == "100% of its blocks off colour"


@settings(max_examples=20, deadline=None)
@given(height=st.integers(1, 140), width=st.integers(1, 140))
def test_any_size_is_compared(height: int, width: int) -> None:
    image = np.random.default_rng(0).random((height, width, 3), dtype=np.float32)
    assert not shifts(image, image, image).any()
    assert not colour_differences(image, image, image).any()


def test_blur_keeps_the_mean_light_but_not_the_mean_of_srgb(sharp: ImageF32) -> None:
    """High contrast under blur would look like a change of colour."""
    contrast = np.where(sharp > 0.5, 1.0, 0.0).astype(np.float32)
    blurred = srgb_from_linear(cv2.blur(linear_from_srgb(contrast), (15, 1)))
    assert colour_differences(contrast, blurred, blurred).max() < LIMITS.max_colour
    assert np.abs(contrast - blurred).mean() > LIMITS.max_colour
    assert abs(float(contrast.mean() - blurred.mean())) > LIMITS.max_colour


def test_limits_and_switch(sharp: ImageF32, observed: ImageF32) -> None:
    moved = np.roll(sharp, -4, axis=0)
    assert rejection_reason(moved, observed, observed, LIMITS) is not None
    assert rejection_reason(moved, observed, observed, GateConfig(max_share=1.0)) is None
    assert rejection_reason(moved, observed, observed, GateConfig(max_shift=5.0, max_colour=1.0)) is None


def test_refused_repairs_stay_on_disk_and_the_render_is_taken(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An expert that returns negatives; a scorer that looks for contrast would take them."""

    class Negative(Sharpen):
        def restore(self, image: ImageF32, **options: Any) -> ImageF32:
            return np.float32(1.0) - super().restore(image, **options)

    monkeypatch.setattr(expert_module, "load_expert", lambda spec, device: Negative())
    monkeypatch.setattr(scorer_module, "load_scorer", lambda spec, device: Contrast())
    warnings: list[str] = []
    monkeypatch.setattr(SilentReporter, "warn", lambda reporter, text: warnings.append(text))
    write_capture(tmp_path)
    chosen, reasons, refused = {}, {}, {}
    for share in (1.0, 0.1):
        context = Capture(tmp_path).context(
            "rivr", tiny_rivr(rounds=1, gate={"max_share": share}), run=f"share {share}"
        )
        (made,) = rivr.run(context).summary["rounds"]
        refused[share] = made["repairs_refused"]
        rows = tried_rows(context)
        assert all(row.accepted for row in rows)
        assert all("restored" in read_exr(context.out / row.exr).layers for row in rows)
        assert [read_row(context.out, row.exr) for row in rows] == rows
        chosen[share], reasons[share] = {row.chosen for row in rows}, {row.reason for row in rows}
    assert "render" not in chosen[1.0]
    assert chosen[0.1] == {"render"}
    assert all(reason.startswith("repair refused: ") for reason in reasons[0.1])
    assert refused == {1.0: 0, 0.1: len(rows)}
    assert [text.partition(":")[0] for text in warnings] == [
        f"{len(rows)} of {len(rows)} repairs by sharpen were refused"
    ]
