"""A tile rasteriser in pure torch, differentiated by autograd: what the kernels are compared with.

Per tile it does the arithmetic of gsplat's torch code (``_torch_impl.accumulate``), dense over the tile's
pixels and splats, with the cut-offs of our image formation. It is written to be fast as such code goes:

* The lists of splats per tile are given, outside its time, and as short as can be: a splat is in a tile's
  list only when its alpha reaches 1/255 at one of the tile's pixels.
* Parameters are gathered once for all tiles, so that the backward pass scatters once.
* Tiles with lists of similar length are stacked, in groups that stay in the cache and keep all threads busy.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from benchmarks.speed.reference import Splats
from cleargs.splat import constants

TILE = 16
GROUP = 1 << 19
"""(pixel, splat) products of a group of tiles, about: two megabytes a tensor. Of 2^15 to 2^21 the fastest."""


class TileGroup(NamedTuple):
    """Tiles that are rasterised together, their lists padded to one length K."""

    tiles: Tensor  # [B] row * tiles across + column
    ids: Tensor  # [B, K] rows of the splats by depth; M, one row past the end, is padding


def tile_lists(splats: Splats, width: int, height: int) -> tuple[Tensor, Tensor]:
    """Rows of the splats in every tile, in their order (depth): counts [T] and rows [P], tile by tile."""
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
    """Tiles [begin, end) that intervals in px overlap."""
    begin = torch.floor((centres - extents) / TILE).clamp(0, tiles).long()
    end = torch.ceil((centres + extents) / TILE).clamp(0, tiles).long()
    return begin, torch.maximum(begin, end)


def _touches(splats: Splats, ids: Tensor, tiles: Tensor, across: int, width: int, height: int) -> Tensor:
    """Whether each splat's alpha reaches 1/255 at a pixel of its tile, [P] bool."""
    centres = pixel_centres(tiles, across, splats.means.dtype)
    inside = (centres[..., 0] < width) & (centres[..., 1] < height)
    alpha = evaluate(centres, splats.means[ids, None], splats.conics[ids, None], splats.opacities[ids, None])
    return ((alpha >= constants.ALPHA_CUT) & inside).any(1)


def groups(counts: Tensor, ids: Tensor, padding: int) -> list[TileGroup]:
    """Stack the tiles that have splats, those with lists of similar length together; ``padding`` is M."""
    offsets = counts.cumsum(0) - counts
    order = torch.argsort(counts, stable=True)
    order = order[counts[order] > 0]
    stacked = []
    start = 0
    while start < len(order):
        # Groups are at most a quarter longer than their shortest list, and bounded in size.
        shortest = int(counts[order[start]])
        most = max(1, GROUP // (TILE * TILE * shortest))
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
    """The image [H, W, 3] over black, differentiable in means, conics, colours and opacities."""
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
    """Pixel centres of tiles, row by row, [B, 256, 2] px."""
    steps = torch.arange(TILE, dtype=dtype) + constants.PIXEL_CENTRE
    grid = torch.stack(torch.meshgrid(steps, steps, indexing="xy"), -1).reshape(-1, 2)
    corners = torch.stack([tiles % across, tiles // across], -1) * TILE
    return corners[:, None].to(dtype) + grid


def evaluate(centres: Tensor, means: Tensor, conics: Tensor, opacities: Tensor) -> Tensor:
    """Opacity times the Gaussian, over the broadcast shape of centres and splats."""
    dx, dy = (centres - means).unbind(-1)
    a, b, c = conics.unbind(-1)
    sigma = 0.5 * (a * dx * dx + c * dy * dy) + b * dx * dy
    alpha: Tensor = opacities * torch.exp(-sigma)
    return alpha


def _blend(group: TileGroup, rows: Tensor, across: int) -> Tensor:
    """Colours [B, 256, 3] of stacked tiles from their splats' rows [B, K, 9]."""
    means, conics, opacities, colours = torch.split(rows, [2, 3, 1, 3], dim=-1)
    centres = pixel_centres(group.tiles, across, rows.dtype)
    raw = evaluate(centres[:, :, None], means[:, None], conics[:, None], opacities[:, None, :, 0])
    alpha = torch.where(raw >= constants.ALPHA_CUT, raw.clamp_max(constants.ALPHA_MAX), 0.0)
    after = torch.cumprod(1 - alpha, -1)
    before = torch.cat([torch.ones_like(after[..., :1]), after[..., :-1]], -1)
    weights = torch.where(after >= constants.TRANSMITTANCE_STOP, alpha * before, 0.0)
    return weights @ colours
