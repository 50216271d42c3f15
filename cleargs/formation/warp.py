"""The linear operator B of a frame: what its sensor gathers of a still image in linear light, and Bᵀ."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from cleargs.formation.motion import Floats, FrameMotion
from cleargs.media.colour import linear_from_srgb, srgb_from_linear
from cleargs.splat.camera import Camera
from cleargs.splat.kernels.cpu import frame_warp as kernels
from cleargs.splat.kernels.cpu import launch
from cleargs.splat.kernels.cpu.pixel import CHANNELS

SAMPLES_PER_PIXEL = 1.0
"""Samples per pixel of a blur's length."""
SAMPLES_PER_DISC_PIXEL = 0.8
"""Samples per pixel of a disc's area."""
MIN_SAMPLES, MAX_SAMPLES = 3, 64

STRIDE = 8
"""Every so many rows and columns, a pixel's displacement helps to set the number of samples."""

_GOLDEN_ANGLE = math.pi * (3.0 - math.sqrt(5.0))
_PLASTIC = 0.7548776662466927
"""The step of a sequence that fills the unit interval evenly: the inverse of the plastic number."""


@dataclass(frozen=True, eq=False)
class DisplacementFields:
    """Where the pixels of a photograph look while they are exposed, in pixels: see the kernels."""

    offset: Floats  # [2, H, W]
    sweep: Floats  # [2, H, W]
    radius: Floats  # [H, W]
    reach: float
    """Farthest that a pixel looks up or down."""

    def samples(self) -> Floats:
        """Enough sample times and disc points that neighbouring ones lie about a pixel apart: [K, 3]."""
        sweeps = np.hypot(*self.sweep[:, ::STRIDE, ::STRIDE])
        longest = float(np.quantile(sweeps, 0.95))
        widest = float(np.quantile(self.radius[::STRIDE, ::STRIDE], 0.95))
        times = math.ceil(SAMPLES_PER_PIXEL * longest) if longest > 0.05 else 1
        points = math.ceil(SAMPLES_PER_DISC_PIXEL * math.pi * widest**2) if widest > 0.05 else 1
        if (count := max(times, points)) > 1:
            count = min(max(MIN_SAMPLES, count), MAX_SAMPLES)
        return samples(count)


@cache
def samples(count: int) -> Floats:
    """``count`` sample times and points of the disc: [count, 3] t, u, v.

    The times are the middles of equal parts of an exposure, from -1/2 to 1/2. The points are a sunflower's
    in an order that has nothing to do with time, their centre moved to the disc's.
    """
    if count == 1:
        return np.zeros((1, 3), np.float32)
    index = np.arange(count)
    place = np.argsort(np.argsort(index * _PLASTIC % 1.0, kind="stable"), kind="stable")
    out, turn = np.sqrt((place + 0.5) / count), place * _GOLDEN_ANGLE
    points = np.stack([out * np.cos(turn), out * np.sin(turn)], axis=1)
    sample_times = (index + 0.5) / count - 0.5
    return np.column_stack([sample_times, points - points.mean(axis=0)]).astype(np.float32)


def displacement_fields(
    motion: FrameMotion, camera: Camera, depth: Floats, alpha: Floats, margin: int = 0, scale: float = 1.0
) -> DisplacementFields:
    """The displacement fields of a frame.

    camera: of the photograph. depth, alpha: as the render at the photograph's pose accumulated them, larger
    by ``margin`` pixels on every side. scale: size of this photograph over that in whose pixels ``motion``
    is.
    """
    shape = (camera.height, camera.width)
    offset, sweep = np.empty((2, *shape), np.float32), np.empty((2, *shape), np.float32)
    radius, reach = np.empty(shape, np.float32), np.empty(camera.height)
    kernels.displacements(
        depth,
        alpha,
        margin,
        motion.median_depth,
        np.array([camera.fx, camera.fy, camera.cx, camera.cy], np.float32),
        (scale * np.stack([motion.pose, motion.blur, motion.skew])).astype(np.float32),
        np.array([scale * motion.disc_px, motion.focus], np.float32),
        offset,
        sweep,
        radius,
        reach,
    )
    return DisplacementFields(offset, sweep, radius, float(reach.max()))


@dataclass(frozen=True, eq=False)
class Warp:
    """B for one frame. ``margin``: pixels by which the image is larger than the photograph on every side."""

    fields: DisplacementFields
    margin: int
    samples: Floats

    @classmethod
    def of(cls, fields: DisplacementFields, margin: int = 0) -> Warp:
        return cls(fields, margin, fields.samples())

    def forward(self, image: Floats) -> Floats:
        """[H + 2 margin, W + 2 margin, 4] -> [H, W, 4], both in linear light with a channel of padding."""
        out = np.empty((*self.fields.radius.shape, CHANNELS), np.float32)
        f = self.fields
        with launch.exclusive():
            kernels.expose(image, self.margin, f.offset, f.sweep, f.radius, self.samples, out)
        return out

    def transpose(self, light: Floats) -> Floats:
        """[H, W, 4] -> [H + 2 margin, W + 2 margin, 4]."""
        height, width, channels = light.shape
        rows, columns = height + 2 * self.margin, width + 2 * self.margin
        reach = min(math.ceil(self.fields.reach) + 3, rows)
        count = -(-height // kernels.BAND)
        bands = np.empty((count, kernels.BAND + 2 * reach, columns, channels), np.float32)
        out = np.empty((rows, columns, channels), np.float32)
        f = self.fields
        with launch.exclusive():
            kernels.spread(light, self.margin, reach, f.offset, f.sweep, f.radius, self.samples, bands, rows)
            kernels.gather(bands, self.margin, reach, out)
        return out


def padded(image: Floats) -> Floats:
    """[H, W, 3] with a fourth channel of zeros, as `Warp` takes it."""
    return np.concatenate([image, np.zeros_like(image[..., :1])], axis=2)


def through_curve(image: Floats, curve: Floats, channels: int = 3) -> tuple[Floats, Floats]:
    """The colours of ``image`` [H, W, 3 or 4] through `linear_curve` or `srgb_curve`, as an image of
    ``channels``, and the slopes there [H, W, 3]."""
    shape = image.shape[:2]
    out, slope = np.empty((*shape, channels), np.float32), np.empty((*shape, 3), np.float32)
    with launch.exclusive():
        kernels.apply_curve(image, curve, out, slope)
    return out, slope


def times_slope(light: Floats, slope: Floats, channels: int = 3) -> Floats:
    """``light`` [H, W, 3 or 4] times ``slope`` [H, W, 3], as an image of ``channels``."""
    out = np.empty((*slope.shape[:2], channels), np.float32)
    with launch.exclusive():
        kernels.multiply(light, slope, out)
    return out


@cache
def linear_curve() -> Floats:
    """From sRGB to linear light, [CURVE_STEPS + 1]."""
    return linear_from_srgb(_places()).astype(np.float32)


@cache
def srgb_curve() -> Floats:
    """From linear light to sRGB, [CURVE_STEPS + 1]."""
    return srgb_from_linear(_places()).astype(np.float32)


def _places() -> NDArray[np.float64]:
    return np.linspace(0.0, kernels.CURVE_LAST, kernels.CURVE_STEPS + 1)
