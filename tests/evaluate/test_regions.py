"""Pixels behind the sparse points, and clipped pixels."""

from __future__ import annotations

import math

import numpy as np
import pytest

from cleargs.evaluate.eval_report import Region
from cleargs.evaluate.metrics import clipped_pixels, depth_of_points, far_pixels, pooled, region
from cleargs.splat.camera import Camera

CAMERA = Camera(40, 30, 50.0, 50.0, 20.0, 15.0, np.eye(4))


def test_the_farthest_point_is_one_that_the_view_sees() -> None:
    rng = np.random.default_rng(0)
    seen = np.column_stack([rng.uniform(-0.3, 0.3, (200, 2)), rng.uniform(2.0, 5.0, 200)])
    outliers = np.array([[0, 0, -9.0], [90, 0, 9], [0, 0, 500]])  # behind, outside, and one wrong match
    farthest = depth_of_points(np.vstack([seen, outliers]), CAMERA)
    assert farthest is not None and 4.8 < farthest <= 5.0
    assert depth_of_points(seen[:9], CAMERA) is None


def test_far_is_also_where_nothing_is_shown() -> None:
    depth = np.array([[3.6, 4.5, 0.1]], np.float32)  # blended: of depth 4, 5 and 1
    alpha = np.array([[0.9, 0.9, 0.1]], np.float32)
    assert far_pixels(depth, alpha, 4.5).tolist() == [[False, True, True]]


def test_a_region_is_measured_where_the_mask_counts() -> None:
    reference = np.full((2, 2, 3), 100, np.uint8)
    reference[0] = [10, 20, 255]
    image = reference.copy()
    image[0, 0] -= 10
    clipped = clipped_pixels(reference)
    assert clipped.tolist() == [[True, True], [False, False]]
    whole = region(image, reference, clipped, None)
    assert whole.share == 0.5 and whole.psnr == pytest.approx(10 * math.log10(255**2 / 50))
    mask = np.array([[False, True], [True, True]])
    assert region(image, reference, clipped, mask) == Region(share=1 / 3, psnr=math.inf)
    assert region(image, reference, clipped, ~clipped) == Region(share=0.0, psnr=None)


def test_images_are_pooled_by_their_errors() -> None:
    parts = [
        Region(share=0.3, psnr=20.0),
        Region(share=0.1, psnr=math.inf),
        Region(share=0.0, psnr=None),
        None,
    ]
    found = pooled(parts)
    assert found is not None and found.share == pytest.approx(0.4 / 3)
    assert found.psnr == pytest.approx(-10 * math.log10(0.3 * 0.01 / 0.4))
    assert pooled([None]) is None and pooled([Region(share=0.0, psnr=None)]) == Region(share=0.0, psnr=None)
