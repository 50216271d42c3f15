"""Which of the raw frame and the render goes to the expert."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt
import pytest

from cleargs.rivr.restoring import shows_more

Image = npt.NDArray[np.float32]


@pytest.fixture(scope="module")
def scene() -> Image:
    """sRGB [240, 320, 3]: polygons with anti-aliased borders."""
    rng = np.random.default_rng(5)
    canvas = np.full((480, 640, 3), 0.4, dtype=np.float32)
    for _ in range(120):
        corners = rng.uniform(0, [640, 480]) + rng.normal(0, 40, (5, 2))
        cv2.fillConvexPoly(
            canvas, cv2.convexHull(corners.astype(np.int32)), rng.uniform(0.1, 0.9, 3).tolist()
        )
    return cv2.resize(canvas, (320, 240), interpolation=cv2.INTER_AREA)


def blurred(image: Image, sigma: float) -> Image:
    return np.asarray(cv2.GaussianBlur(image, (0, 0), sigma), dtype=np.float32)


@pytest.mark.parametrize(
    ("render", "observed", "expected"),
    [(0.6, 1.5, True), (1.5, 0.6, False), (1.0, 1.3, True)],
)
def test_the_sharper_of_two_views(scene: Image, render: float, observed: float, expected: bool) -> None:
    assert shows_more(blurred(scene, render), blurred(scene, observed), None) is expected


def test_noise_is_not_detail(scene: Image) -> None:
    grain = np.random.default_rng(1).normal(0.0, 4 / 255, scene.shape).astype(np.float32)
    assert shows_more(blurred(scene, 0.8), blurred(scene, 1.3) + grain, None)
    assert not shows_more(blurred(scene, 1.3) + grain, blurred(scene, 0.8), None)


def test_a_render_that_is_as_it_should_be_leaves_the_raw_frame(scene: Image) -> None:
    assert not shows_more(scene, scene.copy(), None)


def test_only_what_the_mask_lets_through_counts(scene: Image) -> None:
    half = blurred(scene, 2.0)
    half[:, 160:] = scene[:, 160:]
    right = np.zeros(scene.shape[:2], dtype=bool)
    right[:, 160:] = True
    assert not shows_more(half, blurred(scene, 0.7), ~right)
    assert shows_more(half, blurred(scene, 0.7), right)
