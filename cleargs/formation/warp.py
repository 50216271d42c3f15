"""The linear operator B of a frame: what its sensor gathers of a still image in linear light, and Bᵀ."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from cleargs.formation.motion import Floats, FrameMotion
from cleargs.media.colour import linear_from_srgb, srgb_from_linear
from cleargs.splat.backend import backend_for
from cleargs.splat.camera import Camera
from cleargs.splat.kernels import warp_layout as layout
from cleargs.splat.kernels.warp_layout import DisplacementFields

SAMPLES_PER_PIXEL = 1.0
"""Samples per pixel of a blur's length. With 0.7 scenes end less sharp (up to 0.2 dB, a tenth more LPIPS),
with 1.5 no sharper: docs/experiments/formation.md."""
SAMPLES_PER_DISC_PIXEL = 0.8
"""Samples per pixel of a disc's area."""
MIN_SAMPLES, MAX_SAMPLES = 3, 64
STEPS_APART = 4
"""Samples of neighbouring times write to the same pixels in the transpose. One that follows at once waits for
the other; four steps later it does not: along a row that takes half of the transpose's time, down a column
as much as before."""

STRIDE = 8
"""Every so many rows and columns, a pixel's displacement helps to set the number of samples."""

_GOLDEN_ANGLE = math.pi * (3.0 - math.sqrt(5.0))
_PLASTIC = 0.7548776662466927
"""The step of a sequence that fills the unit interval evenly: the inverse of the plastic number."""


def enough_samples(fields: DisplacementFields) -> Floats:
    """Sample times and disc points such that neighbouring ones lie about a pixel apart: [K, 3]."""
    sweeps = np.hypot(*fields.sweep[:, ::STRIDE, ::STRIDE].cpu().numpy())
    longest = float(np.quantile(sweeps, 0.95))
    widest = float(np.quantile(fields.radius[::STRIDE, ::STRIDE].cpu().numpy(), 0.95))
    times = math.ceil(SAMPLES_PER_PIXEL * longest) if longest > 0.05 else 1
    points = math.ceil(SAMPLES_PER_DISC_PIXEL * math.pi * widest**2) if widest > 0.05 else 1
    if (count := max(times, points)) > 1:
        count = min(max(MIN_SAMPLES, count), MAX_SAMPLES)
    return samples(count)


@cache
def samples(count: int) -> Floats:
    """``count`` sample times and points of the disc: [count, 3] t, u, v.

    The times are the middles of equal parts of an exposure, from -1/2 to 1/2, in the order of `STEPS_APART`.
    The points are a sunflower's in an order that has nothing to do with time, their centre moved to the
    disc's.
    """
    if count == 1:
        return np.zeros((1, 3), np.float32)
    index = np.arange(count)
    place = np.argsort(np.argsort(index * _PLASTIC % 1.0, kind="stable"), kind="stable")
    out, turn = np.sqrt((place + 0.5) / count), place * _GOLDEN_ANGLE
    points = np.stack([out * np.cos(turn), out * np.sin(turn)], axis=1)
    sample_times = (index + 0.5) / count - 0.5
    found = np.column_stack([sample_times, points - points.mean(axis=0)]).astype(np.float32)
    return np.concatenate([found[first::STEPS_APART] for first in range(STEPS_APART)])


def displacement_fields(
    motion: FrameMotion, camera: Camera, depth: Tensor, alpha: Tensor, margin: int = 0, scale: float = 1.0
) -> DisplacementFields:
    """The displacement fields of a frame.

    camera: of the photograph. depth, alpha: as the render at the photograph's pose accumulated them, larger
    by ``margin`` pixels on every side. scale: size of this photograph over that in whose pixels ``motion``
    is.
    """
    numbers = np.empty(layout.MOTION_COLUMNS, np.float32)
    numbers[[layout.FX, layout.FY, layout.CX, layout.CY]] = camera.fx, camera.fy, camera.cx, camera.cy
    numbers[layout.MEDIAN] = motion.median_depth
    numbers[[layout.DISC, layout.FOCUS]] = scale * motion.disc_px, motion.focus
    numbers[layout.TWISTS :] = scale * motion.vector
    return backend_for(depth.device).displacements(depth, alpha, torch.from_numpy(numbers), margin=margin)


@dataclass(frozen=True, eq=False)
class Warp:
    """B for one frame. ``margin``: pixels by which the image is larger than the photograph on every side."""

    fields: DisplacementFields
    margin: int
    samples: Tensor  # [K, 3]

    @classmethod
    def of(cls, fields: DisplacementFields, margin: int = 0) -> Warp:
        return cls(fields, margin, torch.from_numpy(enough_samples(fields)).to(fields.radius.device))

    def forward(self, image: Tensor) -> Tensor:
        """[H + 2 margin, W + 2 margin, 4] -> [H, W, 4], both in linear light with a channel of padding."""
        return backend_for(image.device).expose(image, self.fields, self.samples, margin=self.margin)

    def transpose(self, light: Tensor) -> Tensor:
        """[H, W, 4] -> [H + 2 margin, W + 2 margin, 4]."""
        return backend_for(light.device).expose_backward(light, self.fields, self.samples, margin=self.margin)


def padded(image: Floats) -> Floats:
    """[H, W, 3] with a fourth channel of zeros, as `Warp` takes it."""
    return np.concatenate([image, np.zeros_like(image[..., :1])], axis=2)


def through_curve(image: Tensor, curve: Tensor, channels: int = 3) -> tuple[Tensor, Tensor]:
    """The colours of ``image`` [H, W, 3 or 4] through `linear_curve` or `srgb_curve`, as an image of
    ``channels``, and the slopes there [H, W, 3]."""
    return backend_for(image.device).through_curve(image, curve, channels)


def times_slope(light: Tensor, slope: Tensor, channels: int = 3) -> Tensor:
    """``light`` [H, W, 3 or 4] times ``slope`` [H, W, 3], as an image of ``channels``."""
    return backend_for(light.device).times_slope(light, slope, channels)


@cache
def linear_curve(device: torch.device) -> Tensor:
    """From sRGB to linear light, [CURVE_STEPS + 1]."""
    return torch.from_numpy(linear_from_srgb(_places()).astype(np.float32)).to(device)


@cache
def srgb_curve(device: torch.device) -> Tensor:
    """From linear light to sRGB, [CURVE_STEPS + 1]."""
    return torch.from_numpy(srgb_from_linear(_places()).astype(np.float32)).to(device)


def _places() -> NDArray[np.float64]:
    return np.linspace(0.0, layout.CURVE_LAST, layout.CURVE_STEPS + 1)
