"""The linear operator B of a frame: what its sensor gathers of a still image in linear light, and Bᵀ."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from cleargs.formation.motion import FrameMotion
from cleargs.media.colour import linear_from_srgb, srgb_from_linear
from cleargs.splat.backend import backend_for
from cleargs.splat.camera import Camera
from cleargs.splat.kernels import warp_layout as layout
from cleargs.splat.kernels.warp_layout import DisplacementFields
from cleargs.types import ArrayF32

SAMPLES_PER_PIXEL = 1.0
"""Samples per pixel of a blur's length. With 0.7 scenes end less sharp (up to 0.2 dB, a tenth more LPIPS),
with 1.5 no sharper: docs/experiments/formation.md."""
SAMPLES_PER_DISC_PIXEL = 0.8
"""Samples per pixel of a disc's area."""
MIN_SAMPLES, MAX_SAMPLES = 3, 64
MIN_DIVIDED = 8
"""A blur of so many samples or more is taken in two passes. Scenes end alike, and a step with a blur of 30 px
costs four fifths as much: docs/experiments/formation.md."""
STEPS_APART = 4
"""Samples of neighbouring times write to the same pixels in the transpose. One that follows at once waits for
the other; four steps later it does not: along a row that takes half of the transpose's time, down a column
as much as before."""

STRIDE = 8
"""Every so many rows and columns, a pixel's displacement helps to set the number of samples."""

_GOLDEN_ANGLE = math.pi * (3.0 - math.sqrt(5.0))
_PLASTIC = 0.7548776662466927
"""The step of a sequence that fills the unit interval evenly: the inverse of the plastic number."""


def enough_samples(fields: DisplacementFields) -> tuple[int, int]:
    """How many sample times, and how many points of the disc, lie about a pixel apart.

    One of something that nothing in the frame asks for; at most `MAX_SAMPLES`.
    """
    sweeps = np.hypot(*fields.sweep[:, ::STRIDE, ::STRIDE].cpu().numpy())
    longest = float(np.quantile(sweeps, 0.95))
    widest = float(np.quantile(fields.radius[::STRIDE, ::STRIDE].cpu().numpy(), 0.95))
    times = SAMPLES_PER_PIXEL * longest if longest > 0.05 else 1
    points = SAMPLES_PER_DISC_PIXEL * math.pi * widest**2 if widest > 0.05 else 1
    return _within(times), _within(points)


def _within(count: float) -> int:
    return 1 if count == 1 else min(max(MIN_SAMPLES, math.ceil(count)), MAX_SAMPLES)


@cache
def samples(count: int) -> ArrayF32:
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
    """B for one frame. ``margin``: pixels by which the image is larger than the photograph on every side.

    A long blur is taken in two passes: samples some pixels apart, then the mean over the way from one to the
    next (``between``), so that 30 samples cost 6 + 5. Where all pixels are blurred alike it is the same;
    where neighbours are not, the second pass, a few pixels long, takes them for alike.
    """

    fields: DisplacementFields
    margin: int
    samples: Tensor  # [K, 3]
    between: Warp | None = None

    @classmethod
    def of(cls, fields: DisplacementFields, margin: int = 0) -> Warp:
        device = fields.radius.device
        times, points = enough_samples(fields)
        if points > 1 or times < MIN_DIVIDED:
            return cls(fields, margin, torch.from_numpy(samples(max(times, points))).to(device))
        fine = round(math.sqrt(times))
        coarse = math.ceil(times / fine)
        between = cls(_shortened(fields, coarse), 0, torch.from_numpy(samples(fine)).to(device))
        return cls(fields, margin, torch.from_numpy(samples(coarse)).to(device), between)

    def forward(self, image: Tensor) -> Tensor:
        """[H + 2 margin, W + 2 margin, 4] -> [H, W, 4], both in linear light with a channel of padding."""
        seen = backend_for(image.device).expose(image, self.fields, self.samples, margin=self.margin)
        return seen if self.between is None else self.between.forward(seen)

    def transpose(self, light: Tensor) -> Tensor:
        """[H, W, 4] -> [H + 2 margin, W + 2 margin, 4]."""
        seen = light if self.between is None else self.between.transpose(light)
        return backend_for(light.device).expose_backward(seen, self.fields, self.samples, margin=self.margin)


def _shortened(fields: DisplacementFields, parts: int) -> DisplacementFields:
    """The blur of one of so many equal parts of the exposure, and nothing else."""
    sweep = fields.sweep / parts
    reach = None if fields.reach is None else 0.5 * float(sweep[1].abs().max())
    return DisplacementFields(torch.zeros_like(sweep), sweep, torch.zeros_like(fields.radius), reach)


def padded(image: ArrayF32) -> ArrayF32:
    """[H, W, 3] with a fourth channel of zeros, as `Warp` takes it."""
    return np.concatenate([image, np.zeros_like(image[..., :1])], axis=2)


def through_curve(image: Tensor, curve: Tensor, channels: int = 3) -> tuple[Tensor, Tensor]:
    """The colours of ``image`` [H, W, 3 or 4] through `linear_curve` or `srgb_curve`, as an image of
    ``channels``, and the slopes there [H, W, 3].
    """
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
