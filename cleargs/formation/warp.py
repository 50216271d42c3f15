"""The linear operator B of a frame, from a sharp image to the frame image in linear light, and Bᵀ."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache

import numpy as np
import torch
from torch import Tensor

from cleargs.formation.motion import FrameMotion
from cleargs.media.colour import linear_from_srgb, srgb_from_linear
from cleargs.splat.backend import backend_for
from cleargs.splat.camera import Camera
from cleargs.splat.kernels import warp_layout as layout
from cleargs.splat.kernels.warp_layout import CUBE_REACH, DisplacementFields
from cleargs.types import ArrayF32, ArrayF64

SAMPLES_PER_PIXEL = 1.0
"""Samples per pixel of a blur's length. With 0.7 scenes are less sharp (up to 0.2 dB, a tenth more LPIPS),
with 1.5 they are not sharper (docs/experiments/formation.md)."""
SAMPLES_PER_DISC_PIXEL = 0.8
"""Samples per pixel of a disc's area."""
MIN_SAMPLES, MAX_SAMPLES = 3, 64
MIN_DIVIDED = 8
"""Number of samples from which a blur is computed in two passes. Scenes are as good, and a step with a blur
of 30 px takes four fifths of the time (docs/experiments/formation.md)."""
MAX_BOW = 0.5
"""Largest distance, px, between a part of a curved path and the mean of all parts, which replaces it in the
second pass."""
STEPS_APART = 4
"""Time steps between one sample and the next. In the transpose, samples of neighbouring times write to the
same pixels, and a write that follows at once waits for the one before. This order halves the time of the
transpose for a blur along a row, and does not change it for one along a column."""

STRIDE = 8
"""Distance of the rows and columns whose displacements set the number of samples, px."""

SPEEDS = 8
"""Number of times at which the speed on a curved path is evaluated to measure its length."""

_GOLDEN_ANGLE = math.pi * (3.0 - math.sqrt(5.0))
_PLASTIC = 0.7548776662466927
"""The step of a sequence that fills the unit interval evenly: the inverse of the plastic number."""


def enough_samples(fields: DisplacementFields) -> tuple[int, int]:
    """Return the numbers of sample times and of points of the disc that are about a pixel apart.

    A number is 1 if the frame has no such blur, and at most `MAX_SAMPLES`.
    """
    longest = float(np.quantile(path_lengths(fields, STRIDE), 0.95))
    widest = float(np.quantile(fields.radius[::STRIDE, ::STRIDE].cpu().numpy(), 0.95))
    times = SAMPLES_PER_PIXEL * longest if longest > 0.05 else 0.0
    points = SAMPLES_PER_DISC_PIXEL * math.pi * widest**2 if widest > 0.05 else 0.0
    return _within(times), _within(points)


def path_lengths(fields: DisplacementFields, stride: int = 1) -> ArrayF32:
    """Return the lengths of the paths of every ``stride``-th pixel during the exposure, px, [h, w]."""
    sweep = fields.sweep[:, ::stride, ::stride].cpu().numpy()
    if fields.curve is None:
        return np.asarray(np.hypot(*sweep))
    bend, cube = np.split(fields.curve[:, ::stride, ::stride].cpu().numpy(), 2)
    times = (np.arange(SPEEDS, dtype=np.float32) + np.float32(0.5)) / np.float32(SPEEDS) - np.float32(0.5)
    speeds = [np.hypot(*(sweep + 2 * t * bend + (3 * t * t - np.float32(0.15)) * cube)) for t in times]
    return np.asarray(np.sum(speeds, axis=0, dtype=np.float32) / np.float32(SPEEDS))


def _within(count: float) -> int:
    return min(max(MIN_SAMPLES, math.ceil(count)), MAX_SAMPLES) if count else 1


@cache
def samples(count: int) -> ArrayF32:
    """Return ``count`` sample times and points of the disc: [count, 3] t, u, v.

    The times are the middles of equal parts of an exposure, from -1/2 to 1/2, in the order of `STEPS_APART`.
    The points form a sunflower pattern around the centre of the disc. Their order does not follow the times.
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
    """Return the displacement fields of a frame with ``camera``.

    Accumulated depth and alpha are from a render at the frame's pose, larger than the frame by ``margin``
    pixels on every side. ``motion`` is in pixels of a frame that is 1 / ``scale`` times as large.
    """
    numbers = np.empty(layout.MOTION_COLUMNS, np.float32)
    numbers[[layout.FX, layout.FY, layout.CX, layout.CY]] = camera.fx, camera.fy, camera.cx, camera.cy
    numbers[layout.MEDIAN] = motion.median_depth
    numbers[[layout.DISC, layout.FOCUS]] = scale * motion.disc_px, motion.focus
    numbers[[layout.READ_ACROSS, layout.READ_DOWN]] = motion.columns, not motion.columns
    twists = motion.pose, motion.blur, motion.skew, motion.skew_bend, motion.bend, motion.cube
    numbers[layout.TWISTS :] = scale * np.concatenate(twists)
    return backend_for(depth.device).displacements(depth, alpha, torch.from_numpy(numbers), margin=margin)


@dataclass(frozen=True, eq=False)
class Warp:
    """B for one frame. The image is larger than the frame image by ``margin`` pixels on every side.

    A long blur is computed in two passes: samples some pixels apart, then the mean over the path from one to
    the next (``between``). So 30 samples cost 6 + 5. The result is the same if all pixels have equal blur.
    Otherwise the second pass, a few pixels long, treats neighbouring pixels as if they had.
    """

    fields: DisplacementFields
    margin: int
    samples: Tensor  # [K, 3]
    between: Warp | None = None

    @classmethod
    def of(cls, fields: DisplacementFields, margin: int = 0) -> Warp:
        """Return the operator with enough samples for ``fields``."""
        device = fields.radius.device
        times, points = enough_samples(fields)
        if points > 1 or times < MIN_DIVIDED:
            return cls(fields, margin, torch.from_numpy(samples(max(times, points))).to(device))
        coarse = max(math.ceil(times / round(math.sqrt(times))), _straight_parts(fields))
        fine = max(1, math.ceil(times / coarse))
        if coarse + fine >= times:
            return cls(fields, margin, torch.from_numpy(samples(times)).to(device))
        between = cls(_shortened(fields, coarse), 0, torch.from_numpy(samples(fine)).to(device))
        return cls(fields, margin, torch.from_numpy(samples(coarse)).to(device), between)

    def forward(self, image: Tensor) -> Tensor:
        """Apply B: [H + 2 margin, W + 2 margin, 4] -> [H, W, 4], linear light with a channel of padding."""
        seen = backend_for(image.device).expose(image, self.fields, self.samples, margin=self.margin)
        return seen if self.between is None else self.between.forward(seen)

    def transpose(self, light: Tensor) -> Tensor:
        """Apply Bᵀ: [H, W, 4] -> [H + 2 margin, W + 2 margin, 4]."""
        seen = light if self.between is None else self.between.transpose(light)
        return backend_for(light.device).expose_backward(seen, self.fields, self.samples, margin=self.margin)


def _straight_parts(fields: DisplacementFields) -> int:
    """Return the number of equal parts of the exposure whose paths differ by at most `MAX_BOW`."""
    if fields.curve is None:
        return 1
    bend, cube = np.split(fields.curve[:, ::STRIDE, ::STRIDE].cpu().numpy(), 2)
    # The velocity at time t minus the mean one is 2t bend + (3t^2 - 1/4) cube; it is largest at the ends.
    apart = float(np.quantile(np.hypot(*bend) + 0.5 * np.hypot(*cube), 0.95))
    return math.ceil(0.5 * apart / MAX_BOW)


def _shortened(fields: DisplacementFields, parts: int) -> DisplacementFields:
    """Return the mean blur of ``parts`` equal parts of the exposure, without offset and defocus."""
    whole = fields.sweep if fields.curve is None else fields.sweep + 2.0 * CUBE_REACH * fields.curve[2:]
    sweep = whole / parts
    reach = None if fields.reach is None else 0.5 * float(sweep[1].abs().max())
    return DisplacementFields(torch.zeros_like(sweep), sweep, torch.zeros_like(fields.radius), reach)


def padded(image: ArrayF32) -> ArrayF32:
    """Return [H, W, 3] with a fourth channel of zeros, as `Warp` needs it."""
    return np.concatenate([image, np.zeros_like(image[..., :1])], axis=2)


@cache
def linear_curve(device: torch.device) -> Tensor:
    """Return the curve from sRGB to linear light, [CURVE_STEPS + 1]."""
    return torch.from_numpy(linear_from_srgb(_places()).astype(np.float32)).to(device)


@cache
def srgb_curve(device: torch.device) -> Tensor:
    """Return the curve from linear light to sRGB, [CURVE_STEPS + 1]."""
    return torch.from_numpy(srgb_from_linear(_places()).astype(np.float32)).to(device)


def _places() -> ArrayF64:
    return np.linspace(0.0, layout.CURVE_LAST, layout.CURVE_STEPS + 1)
