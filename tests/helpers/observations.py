"""A synthetic image, a slanted wall, and the photos that a moving camera takes of them."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt
import torch

from cleargs.formation.comparison import FramePair, luminance
from cleargs.formation.motion import FrameMotion
from cleargs.formation.warp import Warp, displacement_fields, padded, samples
from cleargs.media.colour import linear_from_srgb, srgb_from_linear
from cleargs.splat.camera import Camera
from cleargs.splat.kernels.warp_layout import DisplacementFields

Image = npt.NDArray[np.float32]

HEIGHT, WIDTH = 150, 240
CAMERA = Camera(WIDTH, HEIGHT, 200.0, 204.0, 118.0, 77.0, np.eye(4))
ALPHA = np.ones((HEIGHT, WIDTH), np.float32)


def twist(*numbers: float) -> npt.NDArray[np.float64]:
    return np.array(numbers, np.float64)


def wall() -> Image:
    """Depth of a slanted wall between 2 and 5 metres."""
    return np.linspace(2.0, 5.0, WIDTH, dtype=np.float32)[None].repeat(HEIGHT, 0)


MEDIAN = float(np.median(wall()))


def wall_fields(motion: FrameMotion) -> DisplacementFields:
    """Displacements of the pixels of `CAMERA`, in front of the wall, by a motion."""
    return displacement_fields(motion, CAMERA, torch.from_numpy(wall()), torch.from_numpy(ALPHA))


def picture() -> Image:
    """sRGB [H, W, 3]: polygons with anti-aliased borders."""
    rng = np.random.default_rng(5)
    canvas = np.full((2 * HEIGHT, 2 * WIDTH, 3), 0.4, np.float32)
    for _ in range(150):
        corners = rng.uniform(0, [2 * WIDTH, 2 * HEIGHT]) + rng.normal(0, 30, (5, 2))
        colour = rng.uniform(0.1, 0.9, 3).tolist()
        cv2.fillConvexPoly(canvas, cv2.convexHull(corners.astype(np.int32)), colour)
    return np.ascontiguousarray(cv2.resize(canvas, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA))


def observe(truth: Image, motion: FrameMotion, *, noise: float = 1 / 255) -> Image:
    """The photo of a camera with this motion, with more samples than the tested code uses."""
    warp = Warp(wall_fields(motion), 0, torch.from_numpy(samples(301)))
    light = warp.forward(torch.from_numpy(padded(linear_from_srgb(truth)))).numpy()[..., :3]
    grain = noise * np.random.default_rng(0).standard_normal(truth.shape)
    return np.clip(srgb_from_linear(light) + grain, 0, 1).astype(np.float32)


def soft(image: Image, sigma: float = 0.7) -> Image:
    """An image like the render of an unfinished scene: smooth, with slightly wrong colours."""
    return np.asarray(np.clip(cv2.GaussianBlur(image, (0, 0), sigma) * 0.98 + 0.01, 0, 1), np.float32)


def frame_pair(render: Image, observed: Image, weight: Image = ALPHA) -> FramePair:
    """The pair of the frame image ``observed`` and its render, without a margin."""
    seen = np.where(weight[..., None] > 0, observed, render)
    return FramePair(luminance(render), wall(), ALPHA, luminance(seen), weight, CAMERA, 0)


def psnr(image: Image, truth: Image, border: int = 12) -> float:
    inner = np.s_[border:-border, border:-border]
    return float(-10.0 * np.log10(np.mean((image[inner] - truth[inner]) ** 2)))
