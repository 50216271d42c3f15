"""The test that says if an observed frame is blurrier than a render: blurs, and other differences."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest
from helpers.observations import picture

from cleargs.formation.comparison import luminance
from cleargs.formation.estimate import SEARCH_GAIN
from cleargs.formation.pretest import MissingBlur, missing_blur
from cleargs.splat.backend import set_threads
from cleargs.splat.kernels.cpu import backend as cpu
from cleargs.types import ArrayF32


def sharp() -> ArrayF32:
    """Return the linear luminance [H, W] of the drawn picture."""
    return luminance(picture())


def line(length: float, angle: float) -> ArrayF32:
    """Return the kernel of a straight sweep."""
    kernel = np.zeros((41, 41), np.float32)
    for t in np.linspace(-0.5, 0.5, 401):
        x, y = 20 + t * length * math.cos(angle), 20 + t * length * math.sin(angle)
        i, j = math.floor(x), math.floor(y)
        for row, below in ((j, 1 - (y - j)), (j + 1, y - j)):
            kernel[row, i] += below * (1 - (x - i))
            kernel[row, i + 1] += below * (x - i)
    return np.asarray(kernel / kernel.sum())


def disc(radius: float) -> ArrayF32:
    """Return the kernel of a lens out of focus."""
    y, x = np.mgrid[-20:21, -20:21]
    kernel = np.clip(radius + 0.5 - np.hypot(x, y), 0, 1).astype(np.float32)
    return np.asarray(kernel / kernel.sum())


def blurred(kernel: ArrayF32) -> ArrayF32:
    return np.asarray(cv2.filter2D(sharp(), -1, kernel))


def noisy(image: ArrayF32) -> ArrayF32:
    grain = np.random.default_rng(1).standard_normal(image.shape) * 0.005
    return np.asarray(image + grain, np.float32)


def unfinished(image: ArrayF32, sigma: float = 0.8) -> ArrayF32:
    """Return the render of a scene that is still soft."""
    return np.asarray(cv2.GaussianBlur(image, (0, 0), sigma))


def missing(render: ArrayF32, observed: ArrayF32) -> MissingBlur:
    return missing_blur(render, noisy(observed), np.ones_like(observed))


@pytest.mark.parametrize("angle", [0.0, 0.6, 2.0])
@pytest.mark.parametrize("length", [5.0, 8.0, 14.0, 22.0])
def test_a_sweep_has_its_length_and_direction(length: float, angle: float) -> None:
    found = missing(unfinished(sharp()), blurred(line(length, angle)))
    assert found.gain == found.line_gain > 0.5
    assert found.line_gain > found.disc_gain
    # A soft render leaves the shortest part of a blur unseen.
    assert found.length == pytest.approx(length, rel=0.25)
    assert abs(math.sin(found.angle - angle)) < 0.1


@pytest.mark.parametrize("radius", [3.0, 5.0])
def test_a_disc_explains_more_than_a_line(radius: float) -> None:
    found = missing(unfinished(sharp()), blurred(disc(radius)))
    assert found.gain == found.disc_gain > found.line_gain
    assert 2.0 * math.sqrt(found.disc) == pytest.approx(radius, rel=0.25)


@pytest.mark.parametrize("sigma", [0.3, 0.8, 2.0])
def test_a_sharp_frame_gives_no_evidence(sigma: float) -> None:
    """The softer the render, the farther the frame is from being blurrier."""
    assert missing(unfinished(sharp(), sigma), sharp()).gain < SEARCH_GAIN


def test_another_exposure_is_no_blur() -> None:
    assert missing(unfinished(sharp()), np.asarray(0.7 * sharp() + 0.05, np.float32)).gain < SEARCH_GAIN


def test_a_small_misregistration_is_no_blur() -> None:
    """Lanczos keeps the sharpness of what it moves by a third of a pixel."""
    shift = np.array([[1, 0, 0.3], [0, 1, 0.2]], np.float32)
    size = (sharp().shape[1], sharp().shape[0])
    moved = cv2.warpAffine(sharp(), shift, size, flags=cv2.INTER_LANCZOS4, borderMode=cv2.BORDER_REPLICATE)
    assert missing(unfinished(sharp()), np.asarray(moved)).gain < SEARCH_GAIN


def test_nothing_to_see_gives_no_evidence() -> None:
    flat = np.full((60, 80), 0.5, np.float32)
    assert missing_blur(flat, flat, np.ones_like(flat)).gain == 0.0
    assert missing_blur(sharp(), blurred(line(9.0, 0.0)), np.zeros_like(sharp())).gain == 0.0
    for size in ((2, 3), (3, 3), (9, 300)):
        image = np.random.default_rng(0).random(size).astype(np.float32)
        assert math.isfinite(missing_blur(image, image[::-1].copy(), np.ones_like(image)).gain)


def test_pixels_without_weight_say_nothing() -> None:
    observed = noisy(blurred(line(8.0, 0.0)))
    weight = np.ones_like(observed)
    weight[40:90, 60:120] = 0.0
    spoilt = observed.copy()
    spoilt[60:70, 85:95] = 1.0  # far enough from what counts that no smoothing carries it there
    clean, ruined = (missing_blur(sharp(), image, weight) for image in (observed, spoilt))
    assert ruined.length == pytest.approx(clean.length, rel=0.02)


def test_threads_do_not_change_a_bit() -> None:
    found = []
    for threads in (1, 2):
        set_threads(threads)
        found.append(missing(sharp(), blurred(line(8.0, 0.6))))
    assert found[0] == found[1]


def test_sums_are_those_of_numpy() -> None:
    rng = np.random.default_rng(3)
    render, observed = rng.random((2, 21, 30)).astype(np.float32)
    weight = (rng.random((21, 30)) > 0.3).astype(np.float32)
    sums = cpu.blur_sums(render, observed, weight, 2, 8)
    a = render.astype(np.float64)
    middle = a[1:-1, 1:-1]
    x, y = 0.5 * (a[1:-1, 2:] - a[1:-1, :-2]), 0.5 * (a[2:, 1:-1] - a[:-2, 1:-1])
    xx, yy = 0.5 * (a[1:-1, 2:] + a[1:-1, :-2]) - middle, 0.5 * (a[2:, 1:-1] + a[:-2, 1:-1]) - middle
    xy = 0.25 * (a[2:, 2:] - a[2:, :-2] - a[:-2, 2:] + a[:-2, :-2])
    terms = np.stack([np.ones_like(middle), middle, x, y, xx, xy, yy, observed[1:-1, 1:-1]], -1)
    scale = weight[1:-1, 1:-1] / np.maximum(observed[1:-1, 1:-1], 0.02) ** 2
    rows, columns = np.indices(a.shape)
    colour = ((rows // 8 + columns // 8) % 2)[1:-1, 1:-1]
    for k in range(2):
        counted = (scale * (colour == k))[::2, ::2]
        expected = np.einsum("yx,yxn,yxm->nm", counted, terms[::2, ::2], terms[::2, ::2])
        np.testing.assert_allclose(sums[k], expected, rtol=1e-5, atol=1e-6 * np.abs(expected).max())
