"""gsplat's own pure-torch form of the same rasteriser: one flat list of (pixel, splat) intersections.

The arithmetic is that of gsplat's ``_torch_impl.accumulate``. What gsplat leaves to CUDA is replaced: the
list of intersections (``rasterize_to_indices_in_range``) is given, outside its time, and nerfacc's product
along each pixel becomes a running sum of logarithms in float64.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from cleargs.bench.torch_tiles import TILE, evaluate, pixel_centres
from cleargs.splat import constants
from cleargs.splat.kernels.reference import Splats

CHUNK = 4096
"""Pairs whose pixels are looked at together."""


class Intersections(NamedTuple):
    """Every (pixel, splat) that enters the image, by pixel and depth."""

    pixels: Tensor  # [M] y * width + x
    splats: Tensor  # [M] rows of the splats
    starts: Tensor  # [M] where the pixel's entries begin in the list


def intersections(splats: Splats, counts: Tensor, ids: Tensor, width: int, height: int) -> Intersections:
    """From the lists of splats per tile, ``counts`` [T] and ``ids`` [P]: what contributes, until T < 1e-4."""
    across = -(-width // TILE)
    tiles = torch.repeat_interleave(torch.arange(len(counts)), counts)
    found = [
        _inside(splats, some_ids, some_tiles, across, width, height)
        for some_ids, some_tiles in zip(torch.split(ids, CHUNK), torch.split(tiles, CHUNK), strict=True)
    ]
    pixels, rows = (torch.cat(parts) for parts in zip(*found, strict=True))
    order = torch.argsort(pixels, stable=True)
    pixels, rows = pixels[order], rows[order]
    alpha = _alpha(splats, pixels, rows, width)
    starts = _starts(pixels)
    after = _transmittance_before(alpha, starts) * (1 - alpha)
    kept = after >= constants.TRANSMITTANCE_STOP
    pixels, rows = pixels[kept], rows[kept]
    return Intersections(pixels, rows, _starts(pixels))


def accumulate(splats: Splats, found: Intersections, width: int, height: int) -> Tensor:
    """The image [H, W, 3] over black, differentiable in means, conics, colours and opacities."""
    alpha = _alpha(splats, found.pixels, found.splats, width)
    weights = alpha * _transmittance_before(alpha, found.starts)
    colours = weights[:, None] * splats.colours[found.splats]
    image = colours.new_zeros(height * width, 3).index_add(0, found.pixels, colours)
    return image.reshape(height, width, 3)


def _inside(
    splats: Splats, ids: Tensor, tiles: Tensor, across: int, width: int, height: int
) -> tuple[Tensor, Tensor]:
    """Pixels and splats of the intersections of some (tile, splat) pairs."""
    centres = pixel_centres(tiles, across, splats.means.dtype)
    x, y = centres.unbind(-1)
    alpha = evaluate(centres, splats.means[ids, None], splats.conics[ids, None], splats.opacities[ids, None])
    pair, _ = where = torch.nonzero(
        (alpha >= constants.ALPHA_CUT) & (x < width) & (y < height), as_tuple=True
    )
    return y[where].long() * width + x[where].long(), ids[pair]


def _alpha(splats: Splats, pixels: Tensor, rows: Tensor, width: int) -> Tensor:
    centres = torch.stack([pixels % width, pixels // width], -1).to(splats.means.dtype)
    raw = evaluate(
        centres + constants.PIXEL_CENTRE, splats.means[rows], splats.conics[rows], splats.opacities[rows]
    )
    return raw.clamp_max(constants.ALPHA_MAX)


def _starts(pixels: Tensor) -> Tensor:
    """Where the run of equal values that each entry belongs to begins."""
    _, lengths = torch.unique_consecutive(pixels, return_counts=True)
    return torch.repeat_interleave(lengths.cumsum(0) - lengths, lengths)


def _transmittance_before(alpha: Tensor, starts: Tensor) -> Tensor:
    """The product of 1 - alpha over the entries before each one in its run."""
    logarithms = torch.log1p(-alpha).double()
    before = logarithms.cumsum(0) - logarithms
    return torch.exp(before - before[starts]).to(alpha.dtype)
