"""Synthetic degradations of sharp photos: motion blur, defocus, noise, JPEG.

Light adds up before a camera encodes it, so blur is applied to linear values:

    sRGB -> linear -> convolve -> sRGB -> noise -> 8 bits -> (JPEG)

Noise is added to the sRGB values, so that a level has the same effect in shadows and highlights, and 1/255 is
one code value. In linear light it would be thirteen code values in the shadows.

Images are [H, W, 3] float32 sRGB in [0, 1]. All random choices come from ``rng``.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from cleargs.media.colour import linear_from_srgb, srgb_from_linear
from cleargs.types import ImageF32

Kernel: TypeAlias = NDArray[np.float32]

IDENTITY: Kernel = np.ones((1, 1), np.float32)


def line_path(rng: np.random.Generator) -> NDArray[np.float64]:
    """Return a straight path in a random direction: points [N, 2], evenly spaced in time."""
    angle = rng.uniform(0.0, np.pi)
    t = np.linspace(-0.5, 0.5, 257)
    return np.outer(t, [np.cos(angle), np.sin(angle)])


def handheld_path(rng: np.random.Generator) -> NDArray[np.float64]:
    """Return the smooth path of a shaking hand: points [N, 2], evenly spaced in time.

    It is a drift at constant velocity plus three harmonics of tremor with decreasing amplitude. The speed
    varies along the path, so the kernel is denser at turns, as in Boracchi & Foi, "Modeling the performance
    of image restoration from motion blur" (2012).
    """
    t = np.linspace(0.0, 1.0, 257)[:, None]
    path = t * rng.normal(size=2)
    tremor = rng.uniform(0.0, 1.0)
    for harmonic in (1, 2, 3):
        phase = rng.uniform(0.0, 2 * np.pi, size=2)
        amplitude = tremor * rng.normal(size=2) / (2.0 * harmonic)
        path = path + amplitude * np.sin(np.pi * harmonic * t + phase)
    return path


def rasterise_path(path: NDArray[np.float64], length: float) -> Kernel:
    """Return the blur kernel of a path [N, 2], scaled to ``length`` px between its farthest points.

    The kernel is square with odd sides and sums to one. Its centre of mass is at its centre, so that blurring
    does not shift the image. Points are splatted bilinearly.
    """
    coarse = path[::4]
    diameter = float(np.linalg.norm(coarse[:, None] - coarse[None], axis=-1).max())
    points = (path - path.mean(axis=0)) * (length / diameter if diameter > 0 else 0.0)
    radius = int(np.ceil(np.abs(points).max())) + 1
    size = 2 * radius + 1
    corner = np.floor(points).astype(np.int64)
    frac = points - corner
    kernel = np.zeros((size, size), np.float64)
    for dy in (0, 1):
        for dx in (0, 1):
            weight = np.abs(1 - dx - frac[:, 0]) * np.abs(1 - dy - frac[:, 1])
            np.add.at(kernel, (corner[:, 1] + dy + radius, corner[:, 0] + dx + radius), weight)
    return np.asarray(kernel / kernel.sum(), np.float32)


def motion_kernel(rng: np.random.Generator, length: float, line_share: float = 0.4) -> Kernel:
    """Return a random motion kernel of ``length`` px (largest distance between two of its points).

    It is straight with probability ``line_share``, else the path of a shaking hand.
    """
    path = line_path(rng) if rng.random() < line_share else handheld_path(rng)
    return rasterise_path(path, length)


def disc_kernel(radius: float) -> Kernel:
    """Return the kernel of a defocus disc of ``radius`` px with an anti-aliased rim; it sums to one."""
    reach = int(np.ceil(radius)) + 1
    sub = 8
    axis = (np.arange((2 * reach + 1) * sub) + 0.5) / sub - reach - 0.5
    inside = (axis[:, None] ** 2 + axis[None, :] ** 2 <= radius**2).astype(np.float64)
    kernel = inside.reshape(2 * reach + 1, sub, 2 * reach + 1, sub).mean(axis=(1, 3))
    total = kernel.sum()
    return np.asarray(kernel / total, np.float32) if total > 0.0 else IDENTITY


def convolve(linear: ImageF32, kernel: Kernel) -> ImageF32:
    """Convolve an image [H, W, 3] with a kernel, with reflected borders."""
    if kernel.shape == (1, 1):
        return linear
    flipped = np.ascontiguousarray(kernel[::-1, ::-1])  # filter2D correlates
    return np.asarray(cv2.filter2D(linear, -1, flipped, borderType=cv2.BORDER_REFLECT_101), np.float32)


def jpeg(image: ImageF32, quality: int) -> ImageF32:
    """Return the image after JPEG compression (4:2:0 chroma, OpenCV's default)."""
    code = np.round(np.clip(image, 0.0, 1.0) * 255.0).astype(np.uint8)
    _, data = cv2.imencode(".jpg", code[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])
    decoded = np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR), np.float32)
    return decoded[..., ::-1] / np.float32(255.0)


@dataclass(frozen=True)
class Degradation:
    """A degradation of an image.

    Attributes:
        kernel: Blur kernel; the identity leaves the image sharp.
        second: If given, the blur changes across the image from ``kernel`` to ``second``, as with camera
            rotation or depth.
        direction: Direction of that change, radians.
        noise: Standard deviation of Gaussian noise on sRGB values in [0, 1].
        quantise: True to round to 8 bits.
        jpeg_quality: Quality of JPEG compression; None for no JPEG.
    """

    kernel: Kernel = field(default_factory=lambda: IDENTITY)
    second: Kernel | None = None
    direction: float = 0.0
    noise: float = 0.0
    quantise: bool = True
    jpeg_quality: int | None = None


def degrade(image: ImageF32, degradation: Degradation, rng: np.random.Generator) -> ImageF32:
    """Return the degraded image [H, W, 3], float32 sRGB in [0, 1]; ``rng`` draws the noise."""
    if degradation.kernel.shape == (1, 1) and degradation.second is None:
        out = image
    else:
        linear = linear_from_srgb(image)
        blurred = convolve(linear, degradation.kernel)
        if degradation.second is not None:
            ramp = _ramp(image.shape[0], image.shape[1], degradation.direction)
            blurred = blurred + ramp[..., None] * (convolve(linear, degradation.second) - blurred)
        out = srgb_from_linear(np.clip(blurred, 0.0, 1.0))
    if degradation.noise > 0.0:
        out = out + np.float32(degradation.noise) * rng.standard_normal(image.shape, np.float32)
    out = np.clip(out, np.float32(0.0), np.float32(1.0))
    if degradation.quantise:
        out = (np.round(out * 255.0) / 255.0).astype(np.float32)
    if degradation.jpeg_quality is not None:
        out = jpeg(out, degradation.jpeg_quality)
    return np.ascontiguousarray(out, np.float32)


def _ramp(height: int, width: int, direction: float) -> ImageF32:
    """Return values [H, W] that rise from 0 to 1 along ``direction``."""
    y = np.linspace(-1.0, 1.0, height, dtype=np.float32)[:, None]
    x = np.linspace(-1.0, 1.0, width, dtype=np.float32)[None, :]
    reach = abs(np.cos(direction)) + abs(np.sin(direction))
    along = np.cos(direction) * x + np.sin(direction) * y
    return np.asarray(0.5 + 0.5 * along / reach, np.float32)


def shallow_focus(image: ImageF32, rng: np.random.Generator) -> ImageF32:
    """Return the photo with a shallow depth of field: [H, W, 3] float32 sRGB in [0, 1].

    It is out of focus everywhere or, half of the time, in a random mask with edges from a slow change of
    depth to the outline of an object. Two discs in sequence, of 1-10 px radius and a smaller one, give
    profiles from hard to soft.
    """
    linear = linear_from_srgb(image)
    radius = np.exp(rng.uniform(0.0, np.log(10.0)))
    blurred = convolve(convolve(linear, disc_kernel(radius)), disc_kernel(radius * rng.random()))
    if rng.random() < 0.5:
        coarse = rng.standard_normal((4, 4)).astype(np.float32)
        relief = cv2.resize(coarse, image.shape[1::-1], interpolation=cv2.INTER_CUBIC)
        steepness = np.float32(np.exp(rng.uniform(np.log(0.5), np.log(20.0))))
        mask = np.clip(0.5 + steepness * relief, 0.0, 1.0)[..., None]
        blurred = linear + mask * (blurred - linear)
    return srgb_from_linear(np.clip(blurred, 0.0, 1.0))


def handheld_degradation(rng: np.random.Generator) -> Degradation:
    """Return a random degradation of a handheld video frame, for training the restoration expert.

    15 % are sharp, 15 % have motion blur below 7 px and 70 % have blur of 7-22 px, a fifth of which varies
    across the image. Noise is at most 1/255, or 3/255 in a quarter; a quarter has JPEG of quality 60-95.

    There is no defocus: it mostly is the photographer's choice, so the expert must keep it (`shallow_focus`).
    """
    kind = rng.random()
    second = None
    if kind < 0.15:
        kernel = IDENTITY
    elif kind < 0.30:
        kernel = motion_kernel(rng, rng.uniform(0.5, 7.0))
    else:
        length = rng.uniform(7.0, 22.0)
        kernel = motion_kernel(rng, length)
        if rng.random() < 0.2:
            second = motion_kernel(rng, length * rng.uniform(0.5, 1.0))
    return Degradation(
        kernel=kernel,
        second=second,
        direction=rng.uniform(0.0, 2 * np.pi),
        noise=rng.uniform(0.0, 3.0 if rng.random() < 0.25 else 1.0) / 255.0,
        jpeg_quality=int(rng.integers(60, 96)) if rng.random() < 0.25 else None,
    )
