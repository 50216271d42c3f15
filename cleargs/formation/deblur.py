"""Removal of the estimated blur, skew or defocus from a frame image."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from cleargs.formation.warp import Warp, padded
from cleargs.media.colour import linear_from_srgb, srgb_from_linear
from cleargs.types import ArrayF32

PRIOR = 0.1
"""Variance of the part of a frame that its formation does not explain, over that of the error of the render.
Frequencies that the exposure passes with more than this share of their power come from the frame image, the
others from the render."""

OUTLIER = 0.15
"""Difference in sRGB between frame image and exposed render above which a pixel counts less, since it may
show something that moved."""

STEPS = 10
"""Steps of the solver; fifty more change the image by less than 1/255 on average."""

MIN_LINEAR = 0.002
"""Linear light below which the slope of sRGB is that at this value."""


def deblur(
    render: ArrayF32,  # R, sRGB in [0, 1], larger than the frame by the warp's margin on every side
    observed: ArrayF32,  # O, [H, W, 3] sRGB in [0, 1]
    weight: ArrayF32,  # [H, W], 0 where a pixel of ``observed`` does not count
    warp: Warp,
) -> ArrayF32:  # [H, W, 3] sRGB in [0, 1]
    """Return the sharp image X that explains ``observed`` under the formation B of the frame (``warp``).

    X follows ``render`` where B leaves it undetermined:

        argmin_X  |s (B X - O)|^2 + PRIOR |s (X - R)|^2

    s is the slope of sRGB over linear light, so that differences count as in sRGB. Conjugate gradients start
    from X = R.
    """
    start, target = padded(linear_from_srgb(render)), padded(linear_from_srgb(observed))
    forward, transpose = _on_arrays(warp.forward, warp), _on_arrays(warp.transpose, warp)
    exposed = forward(start)
    left = target - exposed
    data = _slope(exposed) ** 2 * weight[..., None]
    differences = np.abs(observed - srgb_from_linear(np.clip(exposed[..., :3], 0.0, 1.0))).max(
        axis=2, keepdims=True
    )
    data /= np.maximum(1.0, differences / OUTLIER)
    seen = _slope(start)

    def normal(change: ArrayF32) -> ArrayF32:
        """Apply the matrix of the normal equations in sRGB: dark and bright parts then converge alike."""
        return transpose(data * forward(change / seen)) / seen + np.float32(PRIOR) * change

    change = _conjugate_gradients(normal, transpose(data * left) / seen)
    m, (height, width, _) = warp.margin, observed.shape
    whole = srgb_from_linear(np.clip(start + change / seen, 0.0, 1.0))
    return np.ascontiguousarray(whole[m : m + height, m : m + width, :3])


def _on_arrays(operator: Callable[[Tensor], Tensor], warp: Warp) -> Callable[[ArrayF32], ArrayF32]:
    """Return one direction of a warp as a function of arrays. It runs on the device of the warp."""

    def called(image: ArrayF32) -> ArrayF32:
        return np.asarray(operator(torch.from_numpy(image).to(warp.samples.device)).cpu())

    return called


def _conjugate_gradients(matrix: Callable[[ArrayF32], ArrayF32], side: ArrayF32) -> ArrayF32:
    solution = np.zeros_like(side)
    residual, direction = side.copy(), side.copy()
    power = _power(residual, residual)
    for _ in range(STEPS):
        if power <= 0.0:
            break
        mapped = matrix(direction)
        step = np.float32(power / _power(direction, mapped))
        solution += step * direction
        residual -= step * mapped
        before, power = power, _power(residual, residual)
        direction = residual + np.float32(power / before) * direction
    return solution


def _power(a: ArrayF32, b: ArrayF32) -> float:
    return float(np.multiply(a, b, dtype=np.float64).sum())


def _slope(linear: ArrayF32) -> ArrayF32:
    """Return the slope of sRGB over linear light."""
    light = np.maximum(linear, MIN_LINEAR)
    return np.asarray(np.where(light <= 0.0031308, 12.92, 1.055 / 2.4 * light ** (1 / 2.4 - 1)), np.float32)
