"""The fusion F = clip(R + D - blur(D))."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from cleargs.rivr.candidates import fuse, gaussian_blur
from cleargs.types import ImageF32


def noise(seed: int) -> ImageF32:
    return np.random.default_rng(seed).random((24, 31, 3), dtype=np.float32)


@given(level=st.floats(0, 1, width=32), sigma=st.floats(0.2, 6))
def test_a_flat_restoration_adds_nothing(level: float, sigma: float) -> None:
    render = noise(0)
    flat = np.full_like(render, level)
    np.testing.assert_array_equal(fuse(render, flat, sigma), render)


def test_detail_comes_from_the_restoration_and_base_from_the_render() -> None:
    """A render that is the blurred restoration gets exactly its detail back."""
    restored = np.float32(0.25) + np.float32(0.5) * noise(1)
    render = gaussian_blur(restored, 2.0).astype(np.float32)
    np.testing.assert_allclose(fuse(render, restored, 2.0), restored, atol=2e-7)


def test_the_result_is_clipped() -> None:
    checker = np.indices((16, 16)).sum(axis=0)[..., None].repeat(3, axis=2) % 2
    fused = fuse(np.full((16, 16, 3), 0.9, np.float32), checker.astype(np.float32), 1.0)
    assert fused.max() == 1.0
    assert fused.min() >= 0.0
    assert fused.dtype == np.float32
