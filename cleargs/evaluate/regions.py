"""Two parts of an image where scenes fail that look well on average: the far, and the clipped."""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from cleargs.evaluate.figures import Figures
from cleargs.evaluate.metrics import Mask, Pixels, psnr
from cleargs.splat.camera import Camera

_FEWEST = 10
"""Sparse points that a view must see before the farthest of them says anything."""
_FARTHEST = 0.99
"""Quantile of their depths: a few are wrong matches, far behind everything."""
_CLIPPED = 254


class Region(Figures):
    """A part of an image, or of all of them."""

    share: float = Field(ge=0, le=1, description="Of the pixels that count.")
    psnr: float | None = Field(description="dB, of its mean squared error; null where it is empty.")


def depth_of_points(
    points: NDArray[np.float64],  # [P, 3] in the scene's world
    camera: Camera,
) -> float | None:
    """The depth behind which the view has no sparse points; None where it sees hardly any."""
    x, y, depth = (points @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]).T
    with np.errstate(divide="ignore", invalid="ignore"):
        column, row = camera.fx * x / depth + camera.cx, camera.fy * y / depth + camera.cy
    seen = (depth > 0) & (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
    return float(np.quantile(depth[seen], _FARTHEST)) if seen.sum() >= _FEWEST else None


def far_pixels(
    depth: NDArray[np.float32],  # [H, W] summed with the weights of blending
    alpha: NDArray[np.float32],  # [H, W]
    farthest: float,
) -> Mask:
    """Where a scene shows something behind ``farthest``, or hardly anything."""
    return np.asarray((alpha < 0.5) | (depth > farthest * alpha))


def clipped_pixels(reference: Pixels) -> Mask:
    """Where a channel is at its upper end."""
    return np.asarray((reference >= _CLIPPED).any(axis=-1))


def region(image: Pixels, reference: Pixels, part: Mask, mask: Mask | None) -> Region:
    """What an image is like in ``part`` of those pixels that ``mask`` lets count."""
    counting = part if mask is None else part & mask
    pixels = part.size if mask is None else int(mask.sum())
    return Region(share=float(counting.sum()) / max(1, pixels), psnr=psnr(image, reference, counting))


def pooled(parts: Iterable[Region | None]) -> Region | None:
    """The region over all images, each of the same weight: PSNR of the mean squared error over its pixels."""
    found = [part for part in parts if part is not None]
    if not found:
        return None
    share = math.fsum(part.share for part in found)
    error = math.fsum(part.share * 10 ** (-part.psnr / 10) for part in found if part.psnr is not None)
    level = None if not share else -10 * math.log10(error / share) if error else math.inf
    return Region(share=share / len(found), psnr=level)
