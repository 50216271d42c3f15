"""The three candidates of a target frame (the paper's Table "RIVR candidates").

Images are [H, W, 3] float32 sRGB in [0, 1].
"""

from __future__ import annotations

from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

Image: TypeAlias = NDArray[np.float32]
CandidateName: TypeAlias = Literal["render", "restored", "fused"]
Chosen: TypeAlias = Literal["render", "restored", "fused", "observed"]
"""A candidate, or the raw frame O_t, which needs none."""

Source: TypeAlias = Literal["observation", "deblurred", "render"]
"""What D_t was restored from: O_t, O_t without the camera's motion, or R_t."""

CANDIDATES: tuple[CandidateName, ...] = ("render", "restored", "fused")
"""R_t, D_t and F_t; in a perfect tie the earlier one is chosen."""


def fuse(render: Image, restored: Image, sigma: float) -> Image:
    """F = clip(R + D - blur_sigma(D)): the render's base with the restored image's fine detail.

    sigma: standard deviation of the Gaussian in pixels; finer detail comes from ``restored``.
    """
    detail = restored - gaussian_blur(restored, sigma)  # float64
    return np.clip(render + detail, 0.0, 1.0).astype(np.float32)


def gaussian_blur(image: Image, sigma: float) -> NDArray[np.float64]:
    """``image`` [H, W, 3] under a separable Gaussian cut at 3 sigma, mirrored at the borders.

    float64 and summed tap by tap in a fixed order: a flat image stays flat to the last bit of float32.
    """
    radius = max(1, int(np.ceil(3.0 * sigma)))
    offsets = np.arange(-radius, radius + 1)
    kernel = np.exp(-0.5 * (offsets / sigma) ** 2)
    kernel /= kernel.sum()
    result = image.astype(np.float64)
    for axis in (0, 1):
        padding = [(radius, radius) if axis == k else (0, 0) for k in range(image.ndim)]
        padded = np.pad(result, padding, mode="symmetric")
        length = result.shape[axis]
        result = np.zeros_like(result)
        for k, weight in enumerate(kernel):
            result += weight * padded.take(np.arange(k, k + length), axis=axis)
    return result
