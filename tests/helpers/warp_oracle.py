"""A reference of a frame's warp in float64, with motions and displacement fields to test it on."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from helpers.observations import MEDIAN, twist
from torch import Tensor

from cleargs.formation.motion import FrameMotion
from cleargs.formation.warp import Warp, padded
from cleargs.splat.camera import Camera
from cleargs.splat.kernels.warp_layout import DisplacementFields

ALL = FrameMotion(
    blur=twist(2, 1, -1, 4, 9, 2),
    skew=twist(1, 0, 2, 3, 5, -2),
    pose=twist(0, 1, 0, -2, 1, 0),
    disc_px=3.0,
    focus=1.4,
    median_depth=MEDIAN,
)

ROLLED = FrameMotion(skew=twist(1, 0, 2, 3, 5, -2), median_depth=MEDIAN)

BENT = replace(ALL, bend=twist(1, 0, 1, -9, 5, 2), cube=twist(0, 4, 0, 30, 25, 9))

SLIGHTLY_BENT = FrameMotion(
    blur=twist(2, 1, -1, 4, 24, 2),
    bend=twist(0, 0, 0, 3, 2, 0),
    cube=twist(0, 0, 0, 4, 2, 1),
    median_depth=MEDIAN,
)

LONG = FrameMotion(blur=twist(2, 1, -1, 4, 19, 2), skew=twist(1, 0, 2, 3, 5, -2), median_depth=MEDIAN)


def tent(distance: Tensor) -> Tensor:
    """Weight of a pixel at a distance in linear interpolation."""
    return (1 - distance.abs()).clamp(min=0)


def keys(distance: Tensor) -> Tensor:
    """Weight of a pixel at a distance in cubic convolution (Keys 1981, a = -1/2)."""
    d = distance.abs()
    near, far = 1.5 * d**3 - 2.5 * d**2 + 1, -0.5 * d**3 + 2.5 * d**2 - 4 * d + 2
    return torch.where(d <= 1, near, torch.where(d < 2, far, torch.zeros_like(d)))


def oracle(image: Tensor, warp: Warp) -> Tensor:
    """The expected result of `Warp.forward`, in float64 with autograd. Its ``image`` are the input pixels."""
    pixels = image.detach().double().cpu().requires_grad_()
    seen = mean_of_samples(pixels, warp.fields, warp.margin, warp.samples)
    if warp.between is not None:
        seen = mean_of_samples(seen, warp.between.fields, 0, warp.between.samples)
    seen.image = pixels  # type: ignore[attr-defined]
    return seen


def mean_of_samples(pixels: Tensor, fields: DisplacementFields, margin: int, points: Tensor) -> Tensor:
    """Mean over the samples of the interpolated image at the displaced positions."""
    rows, columns = pixels.shape[:2]
    height, width = fields.radius.shape
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    total = torch.zeros(height, width, pixels.shape[2], dtype=torch.float64)
    offset, sweep, radius = (field.double().cpu() for field in fields[:3])
    curve = torch.zeros(4, 1, 1, dtype=torch.float64) if fields.curve is None else fields.curve.double().cpu()
    for t, u, v in points.double().cpu():
        aside = (t**2 - 1 / 12) * curve[:2] + (t**3 - 3 * t / 20) * curve[2:]
        at_x = (x + margin + offset[0] + t * sweep[0] + aside[0] + u * radius).clamp(0, columns - 1)
        at_y = (y + margin + offset[1] + t * sweep[1] + aside[1] + v * radius).clamp(0, rows - 1)
        i, j = (
            at_x.floor().clamp(max=max(columns - 2, 0)).long(),
            at_y.floor().clamp(max=max(rows - 2, 0)).long(),
        )
        between = keys if len(points) == 1 else tent
        for m in range(-1, 3):
            for n in range(-1, 3):
                share = between(at_y - j - m) * between(at_x - i - n)
                pixel = pixels[(j + m).clamp(0, rows - 1), (i + n).clamp(0, columns - 1)]
                total = total + share[..., None] * pixel
    return total / len(points)


def random_image(rows: int, columns: int) -> Tensor:
    return torch.from_numpy(padded(np.random.default_rng(1).random((rows, columns, 3)).astype(np.float32)))


def constant_fields(height: int, width: int, dx: float, dy: float, radius: float = 0.0) -> DisplacementFields:
    sweep = torch.empty(2, height, width)
    sweep[0], sweep[1] = dx, dy
    return DisplacementFields(torch.zeros_like(sweep), sweep, torch.full((height, width), radius))


def dot(a: Tensor, b: Tensor) -> float:
    """The scalar product, in float64."""
    return float((a.double() * b.double()).sum())


SMALL = Camera(30, 18, 25.0, 26.0, 14.0, 9.5, np.eye(4))
SCALE = 0.25
"""Size of the small image relative to that of `ALL`, whose blur is 10 px long."""


def scenery(margin: int) -> tuple[Tensor, Tensor]:
    """Accumulated depth and alpha with an edge, a floater, holes, NaN and infinity."""
    height, width = SMALL.height + 2 * margin, SMALL.width + 2 * margin
    depth = torch.full((height, width), 3.0)
    depth[:, width // 2 :] = 1.5
    alpha = torch.linspace(0.4, 1.0, width).repeat(height, 1)
    depth[6, 8:16] = torch.tensor([np.nan, np.inf, 0.0, -1.0, 1e-4, 1e-30, 3e38, 5.0])
    alpha[9, 10:14] = torch.tensor([np.nan, 0.0, 0.5, 1.0])
    return depth, alpha


def placed(fields: DisplacementFields, device: torch.device) -> DisplacementFields:
    curve = None if fields.curve is None else fields.curve.to(device)
    return DisplacementFields(*(field.to(device) for field in fields[:3]), None, curve)
