"""A raw frame without the motion that blurred and skewed it."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cleargs.media.colour import LUMA, linear_from_srgb, srgb_from_linear
from cleargs.rivr.motion.fit import fit_motion
from cleargs.rivr.motion.kernels import expose, spread
from cleargs.rivr.motion.model import Floats, Motion, flow_basis, instants
from cleargs.splat.camera import Camera
from cleargs.splat.kernels.cpu import launch

PRIOR = 0.1
"""Variance of what the model of the exposure leaves unexplained, relative to that of the render's error. What
the exposure lets through with more than this share of its power is the raw frame's, the rest the render's."""

OUTLIER = 0.15
"""Difference in sRGB between raw frame and exposed render from which a pixel counts less: what moved."""

STEPS = 10
"""Of the solver; fifty more change the image by less than 1/255 on average."""

SAMPLES_PER_PIXEL = 1.5
FEWEST_SAMPLES, MOST_SAMPLES = 3, 61

DARKEST = 0.002
"""Linear light below which sRGB counts as steep as here."""


@dataclass(frozen=True, eq=False)
class Deblurred:
    """A raw frame without the camera's motion."""

    image: Floats
    """[H, W, 3] sRGB in [0, 1], at the frame's pose."""
    blur_px: float
    """Mean length of the way of the pixels while they were exposed."""
    skew_px: float
    """Mean way from the first to the last row's exposure."""


def deblur(
    render: Floats, observed: Floats, mask: NDArray[np.bool_] | None, camera: Camera, depth: Floats
) -> Deblurred:
    """Find the motion of the camera during a frame's exposure, and undo it.

    Args:
        render, observed: the scene at the frame's pose and the raw frame, [H, W, 3] sRGB in [0, 1].
        mask: [H, W], True where a pixel counts; None: all do.
        camera, depth: of the render; depth [H, W] along the optical axis.
    """
    with launch.exclusive():
        seen, weight, motion, basis = _explained(render, observed, mask, camera, depth)
        image = undo_motion(render, seen, weight, motion, basis)
    lengths = [np.hypot(*np.tensordot(twist, basis, 1)).mean() for twist in (motion.blur, motion.skew)]
    return Deblurred(image, *map(float, lengths))


def as_photographed(
    render: Floats, observed: Floats, mask: NDArray[np.bool_] | None, camera: Camera, depth: Floats
) -> Floats:
    """The render with the motion that makes it most like the raw frame: what a scene says of that frame.

    Arguments as of `deblur`; returns [H, W, 3] sRGB in [0, 1].
    """
    with launch.exclusive():
        _, _, motion, basis = _explained(render, observed, mask, camera, depth)
        exposed = _Exposure(motion, basis)(expose, linear_from_srgb(render))
    return srgb_from_linear(np.clip(exposed, 0.0, 1.0))


def undo_motion(render: Floats, observed: Floats, weight: Floats, motion: Motion, basis: Floats) -> Floats:
    """The image that looks like ``observed`` under ``motion``, and like ``render`` where that leaves it open.

        argmin_X  |s (B X - O)|^2 + PRIOR |s (X - R)|^2

    B exposes an image along the motion; s is the slope of sRGB over linear light, so that differences count
    as they are seen. Solved by conjugate gradients from X = R.

    Args:
        render, observed: R and O, [H, W, 3] sRGB in [0, 1].
        weight: [H, W], 0 where a pixel of ``observed`` does not count.
        basis: `flow_basis` of the render's depth.

    Returns [H, W, 3] sRGB in [0, 1].
    """
    through = _Exposure(motion, basis)
    start, target = linear_from_srgb(render), linear_from_srgb(observed)
    exposed = through(expose, start)
    left = target - exposed
    data = _slope(exposed) ** 2
    data *= (weight * through.within())[..., None]
    differences = np.abs(observed - srgb_from_linear(exposed)).max(axis=2, keepdims=True)
    data /= np.maximum(1.0, differences / OUTLIER)
    seen = _slope(start)

    def normal(change: Floats) -> Floats:
        """Of the change as it is seen: dark and bright parts then converge alike."""
        return through(spread, data * through(expose, change / seen)) / seen + np.float32(PRIOR) * change

    change = _conjugate_gradients(normal, through(spread, data * left) / seen)
    return srgb_from_linear(np.clip(start + change / seen, 0.0, 1.0))


class _Exposure:
    """The kernels, along the ways of one frame."""

    def __init__(self, motion: Motion, basis: Floats) -> None:
        self._offset, self._sweep = motion.ways(basis)
        longest = float(np.quantile(np.hypot(*self._sweep), 0.95))
        wanted = math.ceil(SAMPLES_PER_PIXEL * longest)
        self._times = instants(min(max(FEWEST_SAMPLES, wanted), MOST_SAMPLES))

    def __call__(self, kernel: Callable[..., None], image: Floats) -> Floats:
        out = np.empty_like(image)
        kernel(image, self._offset, self._sweep, self._times, out)
        return out

    def within(self) -> Floats:
        """1 where a pixel's way begins and ends within the image, 0 elsewhere: [H, W]."""
        height, width = self._offset.shape[1:]
        inside = np.ones((height, width), np.float32)
        for end in (-0.5, 0.5):
            x, y = np.indices((height, width))[::-1] + self._offset + np.float32(end) * self._sweep
            inside *= (x >= 0) & (x <= width - 1) & (y >= 0) & (y <= height - 1)
        return inside


def _explained(
    render: Floats, observed: Floats, mask: NDArray[np.bool_] | None, camera: Camera, depth: Floats
) -> tuple[Floats, Floats, Motion, Floats]:
    """The raw frame with the render where it is masked, its weight, its motion, and the flow basis."""
    if mask is None:
        mask = np.ones(depth.shape, np.bool_)
    seen, weight = np.where(mask[..., None], observed, render), mask.astype(np.float32)
    motion = fit_motion(_luminance(render), _luminance(seen), weight, camera, depth)
    return seen, weight, motion, flow_basis(camera, depth)


def _luminance(image: Floats) -> Floats:
    """Linear luminance [H, W] of an sRGB image."""
    kr, kb = LUMA["bt709"]
    return linear_from_srgb(image) @ np.array([kr, 1.0 - kr - kb, kb], np.float32)


def _conjugate_gradients(matrix: Callable[[Floats], Floats], side: Floats) -> Floats:
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


def _power(a: Floats, b: Floats) -> float:
    return float(np.multiply(a, b, dtype=np.float64).sum())


def _slope(linear: Floats) -> Floats:
    """Of sRGB over linear light."""
    light = np.maximum(linear, DARKEST)
    return np.asarray(np.where(light <= 0.0031308, 12.92, 1.055 / 2.4 * light ** (1 / 2.4 - 1)), np.float32)
