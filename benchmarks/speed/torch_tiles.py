"""A tile rasteriser in pure torch with autograd, with which the kernels are compared.

Per tile it does the same arithmetic as gsplat's torch code (``_torch_impl.accumulate``), dense over the
pixels and splats of the tile, with the cut-offs of our rasteriser. It is fast for pure torch:

* The lists of splats per tile are computed before timing starts, and are minimal: a splat is in a list only
  if its alpha reaches 1/255 at a pixel of the tile.
* Parameters are gathered once for all tiles, so that the backward pass scatters once.
* Tiles with lists of similar length are stacked. Groups fit the cache and use all threads.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from benchmarks.speed.reference import Splats
from cleargs.splat import constants

TILE = 16
GROUP_PRODUCTS = 1 << 19
"""Approximate number of (pixel, splat) products per group of tiles: 2 MB per tensor. It is the fastest value
from 2^15 to 2^21."""


class TileGroup(NamedTuple):
    """Tiles that are rasterised together, with lists padded to one length K."""

    tiles: Tensor  # [B] row * tiles across + column
    ids: Tensor  # [B, K] rows of the splats in depth order; M, one row past the end, is padding


def tile_lists(splats: Splats, width: int, height: int) -> tuple[Tensor, Tensor]:
    """Return the number of splats per tile [T], and their rows [P] in depth order, tile by tile."""
    across, down = -(-width // TILE), -(-height // TILE)
    a, b, c = splats.conics.unbind(-1)
    det = a * c - b * b
    reach = 2 * torch.log(splats.opacities / constants.ALPHA_CUT).clamp_min(0)
    columns = _range(splats.means[:, 0], (reach * c / det).sqrt(), across)
    rows = _range(splats.means[:, 1], (reach * a / det).sqrt(), down)
    wide = columns[1] - columns[0]
    boxes = wide * (rows[1] - rows[0])
    ids = torch.repeat_interleave(torch.arange(len(boxes)), boxes)
    place = torch.arange(len(ids)) - (boxes.cumsum(0) - boxes)[ids]
    tiles = (rows[0][ids] + place // wide[ids]) * across + columns[0][ids] + place % wide[ids]
    touched = torch.cat(
        [
            _touches(splats, some_ids, some_tiles, across, width, height)
            for some_ids, some_tiles in zip(torch.split(ids, 4096), torch.split(tiles, 4096), strict=True)
        ]
    )
    ids, tiles = ids[touched], tiles[touched]
    order = torch.argsort(tiles, stable=True)
    return torch.bincount(tiles, minlength=across * down), ids[order]


def _range(centres: Tensor, extents: Tensor, tiles: int) -> tuple[Tensor, Tensor]:
    """Return the tiles [begin, end) that intervals in px overlap."""
    begin = torch.floor((centres - extents) / TILE).clamp(0, tiles).long()
    end = torch.ceil((centres + extents) / TILE).clamp(0, tiles).long()
    return begin, torch.maximum(begin, end)


def _touches(splats: Splats, ids: Tensor, tiles: Tensor, across: int, width: int, height: int) -> Tensor:
    """Return [P] bool: True if the splat's alpha reaches 1/255 at a pixel of the tile."""
    centres = pixel_centres(tiles, across, splats.means.dtype)
    inside = (centres[..., 0] < width) & (centres[..., 1] < height)
    alpha = evaluate(centres, splats.means[ids, None], splats.conics[ids, None], splats.opacities[ids, None])
    return ((alpha >= constants.ALPHA_CUT) & inside).any(1)


def groups(counts: Tensor, ids: Tensor, padding: int) -> list[TileGroup]:
    """Stack tiles with lists of similar length, without empty tiles; ``padding`` is M."""
    offsets = counts.cumsum(0) - counts
    order = torch.argsort(counts, stable=True)
    order = order[counts[order] > 0]
    stacked = []
    start = 0
    while start < len(order):
        # Lists of a group are at most a quarter longer than its shortest one, and groups have a maximum size.
        shortest = int(counts[order[start]])
        most = max(1, GROUP_PRODUCTS // (TILE * TILE * shortest))
        tiles = order[start : start + most]
        tiles = tiles[counts[tiles] <= max(shortest + 4, shortest * 5 // 4)]
        longest = int(counts[tiles].max())
        place = torch.arange(longest)
        inside = place < counts[tiles, None]
        rows = ids[(offsets[tiles, None] + place).clamp_max(len(ids) - 1)]
        stacked.append(TileGroup(tiles, torch.where(inside, rows, padding)))
        start += len(tiles)
    return stacked


def rasterise(splats: Splats, stacked: list[TileGroup], width: int, height: int) -> Tensor:
    """Return the image [H, W, 3] over black, differentiable in means, conics, colours and opacities."""
    across, down = -(-width // TILE), -(-height // TILE)
    columns = torch.cat([splats.means, splats.conics, splats.opacities[:, None], splats.colours], 1)
    table = torch.cat([columns, columns.new_zeros(1, columns.shape[1])])
    rows = table[torch.cat([group.ids.flatten() for group in stacked])]
    parts = torch.split(rows, [group.ids.numel() for group in stacked])
    pictures = [
        _blend(group, part.reshape(*group.ids.shape, -1), across)
        for group, part in zip(stacked, parts, strict=True)
    ]
    filled = torch.cat([group.tiles for group in stacked])
    canvas = columns.new_zeros(down * across, TILE * TILE, 3).index_copy(0, filled, torch.cat(pictures))
    image = canvas.reshape(down, across, TILE, TILE, 3).transpose(1, 2).reshape(down * TILE, across * TILE, 3)
    return image[:height, :width]


def pixel_centres(tiles: Tensor, across: int, dtype: torch.dtype) -> Tensor:
    """Return the pixel centres of tiles, row by row: [B, 256, 2] px."""
    steps = torch.arange(TILE, dtype=dtype) + constants.PIXEL_CENTRE
    grid = torch.stack(torch.meshgrid(steps, steps, indexing="xy"), -1).reshape(-1, 2)
    corners = torch.stack([tiles % across, tiles // across], -1) * TILE
    return corners[:, None].to(dtype) + grid


def evaluate(centres: Tensor, means: Tensor, conics: Tensor, opacities: Tensor) -> Tensor:
    """Return opacity times Gaussian, in the broadcast shape of centres and splats."""
    dx, dy = (centres - means).unbind(-1)
    a, b, c = conics.unbind(-1)
    sigma = 0.5 * (a * dx * dx + c * dy * dy) + b * dx * dy
    alpha: Tensor = opacities * torch.exp(-sigma)
    return alpha


def _blend(group: TileGroup, rows: Tensor, across: int) -> Tensor:
    """Blend stacked tiles from the rows of their splats [B, K, 9]; return colours [B, 256, 3]."""
    means, conics, opacities, colours = torch.split(rows, [2, 3, 1, 3], dim=-1)
    centres = pixel_centres(group.tiles, across, rows.dtype)
    raw = evaluate(centres[:, :, None], means[:, None], conics[:, None], opacities[:, None, :, 0])
    alpha = torch.where(raw >= constants.ALPHA_CUT, raw.clamp_max(constants.ALPHA_MAX), 0.0)
    after = torch.cumprod(1 - alpha, -1)
    before = torch.cat([torch.ones_like(after[..., :1]), after[..., :-1]], -1)
    weights = torch.where(after >= constants.TRANSMITTANCE_STOP, alpha * before, 0.0)
    return weights @ colours
