"""Tile rasterisation, forward and backward, with the mathematics of the CPU back end's ``rasterise``.

Forward, a program is a tile. Its 256 pixels are the vector, and its pairs are blended from near to far.
Behind every ``device_layout.CHUNK`` pairs it stores the transmittance T and the colour that the chunk added
to each pixel. ``behind`` sums these from the far end into S, the part of g · pixel that is behind each chunk.
T and S at its far end are all that a chunk needs for its derivatives. Backward, a program is therefore a
chunk, and long lists of pairs are distributed over many programs:

    v = dL/d(ln alpha) = w (g · c) - S alpha / (1 - alpha),   0 where alpha is clamped.

The sums over a pair's pixels are reduced within the program and stored once, at the pair's slot.
"""

from __future__ import annotations

import triton
import triton.language as tl

from cleargs.splat import constants
from cleargs.splat.kernels import splat_layout as layout
from cleargs.splat.kernels.cuda import device_layout


@triton.jit
def pixels_of(tile, width, height):
    """Return each pixel's number in the tile and in the image, the mask of those inside, and x and y, px."""
    tiles_x = (width + layout.TILE - 1) // layout.TILE
    pixel = tl.arange(0, layout.TILE_PIXELS)
    column = (tile % tiles_x) * layout.TILE + pixel % layout.TILE
    line = (tile // tiles_x) * layout.TILE + pixel // layout.TILE
    inside = (column < width) & (line < height)
    x = column.to(tl.float32) + constants.PIXEL_CENTRE
    y = line.to(tl.float32) + constants.PIXEL_CENTRE
    return pixel, line * width + column, inside, x, y


@triton.jit
def first_chunk(begin, tile):
    """Return the number of the first chunk of a tile whose places start at ``begin``."""
    return begin // device_layout.CHUNK + tile


@triton.jit
def splat_alpha(x, y, row):
    """Return u, dy, alpha before clamp and cut, and blended alpha of a packed splat, at pixel centres.

    The fused operations are explicit, so that forward and backward pass make the same cut to the bit.
    """
    dy = y - tl.load(row + layout.MEAN_Y)
    u = tl.fma(-tl.load(row + layout.SKEW), dy, x - tl.load(row + layout.MEAN_X))
    on_ridge = tl.fma(-(tl.load(row + layout.BEND_Y) * dy), dy, tl.load(row + layout.LOG2_OPACITY))
    raw = tl.exp2(tl.fma(-(tl.load(row + layout.BEND_X) * u), u, on_ridge))
    alpha = tl.where(raw >= constants.ALPHA_CUT, tl.minimum(raw, constants.ALPHA_MAX), 0.0)
    return u, dy, raw, alpha


@triton.jit(do_not_specialize=["width", "height"])
def forward(
    tile_starts,
    pair_ids,
    splats,
    back_red,
    back_green,
    back_blue,
    image,
    alpha,
    transmittance,
    last,
    depth,
    chunk_planes,
    chunk_tiles,
    deepest,
    reached,
    width,
    height,
    WITH_DEPTH: tl.constexpr,
    PLANES: tl.constexpr,
):
    """Store one tile of image [H, W, 3], alpha, transmittance, last contributor (from 1) and depth [H, W].

    Also store, for the backward pass, the planes of its chunks [C, PLANES, 256], the tile of each chunk, and
    the number of the tile's last contributor; and 1 in ``reached`` [N] for each Gaussian up to that one.
    """
    tile = tl.program_id(0)
    pixel, at, inside, x, y = pixels_of(tile, width, height)
    begin, end = tl.load(tile_starts + tile), tl.load(tile_starts + tile + 1)
    chunk = first_chunk(begin, tile)
    chunks = first_chunk(end, tile + 1) - chunk
    for first in range(0, chunks, layout.TILE_PIXELS):
        number = first + pixel
        tl.store(chunk_tiles + chunk + number, tl.zeros_like(pixel) + tile, mask=number < chunks)

    # `live` is T until the pixel stops, then 0 (also outside the image). `rest` keeps T.
    live = tl.where(inside, 1.0, 0.0)
    rest = tl.zeros_like(x) + 1.0
    deep = tl.zeros_like(pixel)
    red = tl.zeros_like(x)
    green = tl.zeros_like(x)
    blue = tl.zeros_like(x)
    z = tl.zeros_like(x)
    start = begin
    goes_on = begin < end
    while goes_on:
        stop = tl.minimum(start + device_layout.CHUNK, end)
        chunk_red = tl.zeros_like(x)
        chunk_green = tl.zeros_like(x)
        chunk_blue = tl.zeros_like(x)
        chunk_z = tl.zeros_like(x)
        following = tl.load(pair_ids + start)
        for place in range(start, stop):
            # The next number is loaded early: the loads that depend on it wait for memory only once.
            g = following
            following = tl.load(pair_ids + tl.minimum(place + 1, stop - 1))
            row = splats + g.to(tl.int64) * layout.SPLAT_COLUMNS
            _, _, _, blended = splat_alpha(x, y, row)
            weight = blended * live
            after = live - weight
            blends = after >= constants.TRANSMITTANCE_STOP
            weight = tl.where(blends, weight, 0.0)
            live = tl.where(blends, after, 0.0)
            rest = tl.where(blends, after, rest)
            deep = tl.where(weight > 0.0, place - begin + 1, deep)
            chunk_red += weight * tl.load(row + layout.RED)
            chunk_green += weight * tl.load(row + layout.GREEN)
            chunk_blue += weight * tl.load(row + layout.BLUE)
            if WITH_DEPTH:
                chunk_z += weight * tl.load(row + layout.DEPTH)
        planes = chunk_planes + chunk.to(tl.int64) * (PLANES * layout.TILE_PIXELS) + pixel
        tl.store(planes + device_layout.CHUNK_TRANSMITTANCE * layout.TILE_PIXELS, rest)
        tl.store(planes + device_layout.CHUNK_RED * layout.TILE_PIXELS, chunk_red)
        tl.store(planes + device_layout.CHUNK_GREEN * layout.TILE_PIXELS, chunk_green)
        tl.store(planes + device_layout.CHUNK_BLUE * layout.TILE_PIXELS, chunk_blue)
        red += chunk_red
        green += chunk_green
        blue += chunk_blue
        if WITH_DEPTH:
            tl.store(planes + device_layout.CHUNK_DEPTH * layout.TILE_PIXELS, chunk_z)
            z += chunk_z
        chunk += 1
        start = stop
        goes_on = (start < end) & (tl.max(live, axis=0) > 0.0)

    contributing = tl.max(deep, axis=0)
    tl.store(deepest + tile, contributing)
    for first in range(0, contributing, layout.TILE_PIXELS):
        number = first + pixel
        g = tl.load(pair_ids + begin + number, mask=number < contributing, other=0)
        tl.store(reached + g, tl.zeros_like(pixel) + 1, mask=number < contributing)
    tl.store(image + at * 3, red + rest * back_red, mask=inside)
    tl.store(image + at * 3 + 1, green + rest * back_green, mask=inside)
    tl.store(image + at * 3 + 2, blue + rest * back_blue, mask=inside)
    tl.store(alpha + at, 1.0 - rest, mask=inside)
    tl.store(transmittance + at, rest, mask=inside)
    tl.store(last + at, deep, mask=inside)
    if WITH_DEPTH:
        tl.store(depth + at, z, mask=inside)


@triton.jit(do_not_specialize=["width", "height"])
def behind(
    tile_starts,
    chunk_planes,
    deepest,
    back_red,
    back_green,
    back_blue,
    transmittance,
    grad_image,
    grad_alpha,
    grad_depth,
    chunk_behind,
    width,
    height,
    HAS_ALPHA: tl.constexpr,
    HAS_DEPTH: tl.constexpr,
    PLANES: tl.constexpr,
):
    """Store S, the part of g · pixel behind the chunk, for every chunk that contributes: [C, 256]."""
    tile = tl.program_id(0)
    pixel, at, inside, _, _ = pixels_of(tile, width, height)
    red = tl.load(grad_image + at * 3, mask=inside, other=0.0)
    green = tl.load(grad_image + at * 3 + 1, mask=inside, other=0.0)
    blue = tl.load(grad_image + at * 3 + 2, mask=inside, other=0.0)
    far = red * back_red + green * back_green + blue * back_blue
    if HAS_ALPHA:  # alpha = 1 - T
        far -= tl.load(grad_alpha + at, mask=inside, other=0.0)
    far *= tl.load(transmittance + at, mask=inside, other=0.0)
    chunk = first_chunk(tl.load(tile_starts + tile), tile).to(tl.int64)
    reached = (tl.load(deepest + tile) + (device_layout.CHUNK - 1)) // device_layout.CHUNK
    for step in range(0, reached):
        number = chunk + (reached - 1 - step)
        tl.store(chunk_behind + number * layout.TILE_PIXELS + pixel, far)
        planes = chunk_planes + number * (PLANES * layout.TILE_PIXELS) + pixel
        far += red * tl.load(planes + device_layout.CHUNK_RED * layout.TILE_PIXELS)
        far += green * tl.load(planes + device_layout.CHUNK_GREEN * layout.TILE_PIXELS)
        far += blue * tl.load(planes + device_layout.CHUNK_BLUE * layout.TILE_PIXELS)
        if HAS_DEPTH:
            z = tl.load(grad_depth + at, mask=inside, other=0.0)
            far += z * tl.load(planes + device_layout.CHUNK_DEPTH * layout.TILE_PIXELS)


@triton.jit(do_not_specialize=["width", "height"])
def backward(
    tile_starts,
    chunk_tiles,
    chunk_planes,
    chunk_behind,
    deepest,
    pair_ids,
    pair_slots,
    splats,
    last,
    grad_image,
    grad_depth,
    pair_sums,
    reached,
    width,
    height,
    HAS_DEPTH: tl.constexpr,
    PLANES: tl.constexpr,
    COLUMNS: tl.constexpr,
):
    """Store the sums of every pair of one chunk, in the rows of ``pair_sums`` [P, 10] at the pairs' slots.

    Pairs are visited from far to near. A chunk that its tile does not need has no pairs. Those of Gaussians
    without ``reached`` are left out.
    """
    chunk = tl.program_id(0)
    tile = tl.load(chunk_tiles + chunk)
    begin = tl.load(tile_starts + tile)
    start = begin + (chunk - first_chunk(begin, tile)) * device_layout.CHUNK
    end = tl.minimum(start + device_layout.CHUNK, tl.load(tile_starts + tile + 1))
    contributing = tl.minimum(end, begin + tl.load(deepest + tile))

    places = start + tl.arange(0, device_layout.CHUNK)
    unseen = (places >= contributing) & (places < end)
    owners = tl.load(pair_ids + places, mask=unseen, other=0)
    unseen = unseen & (tl.load(reached + owners, mask=unseen, other=0) > 0)
    slots = tl.load(pair_slots + places, mask=unseen, other=0).to(tl.int64)
    for k in tl.static_range(COLUMNS):
        tl.store(pair_sums + slots * layout.PAIR_COLUMNS + k, 0.0, mask=unseen)
    if start < contributing:
        pixel, at, inside, x, y = pixels_of(tile, width, height)
        deep = tl.load(last + at, mask=inside, other=0)
        grad_red = tl.load(grad_image + at * 3, mask=inside, other=0.0)
        grad_green = tl.load(grad_image + at * 3 + 1, mask=inside, other=0.0)
        grad_blue = tl.load(grad_image + at * 3 + 2, mask=inside, other=0.0)
        number = chunk.to(tl.int64) * layout.TILE_PIXELS
        planes = chunk_planes + number * PLANES + pixel
        t = tl.load(planes + device_layout.CHUNK_TRANSMITTANCE * layout.TILE_PIXELS)
        far = tl.load(chunk_behind + number + pixel)
        if HAS_DEPTH:
            grad_z = tl.load(grad_depth + at, mask=inside, other=0.0)
        following = tl.load(pair_ids + contributing - 1)
        for step in range(0, contributing - start):
            place = contributing - 1 - step
            g = following
            following = tl.load(pair_ids + tl.maximum(place - 1, start))
            row = splats + g.to(tl.int64) * layout.SPLAT_COLUMNS
            u, dy, raw, blended = splat_alpha(x, y, row)
            blended = tl.where(deep > place - begin, blended, 0.0)
            inverse = 1.0 / (1.0 - blended)
            t = t * inverse
            weight = blended * t
            gain = grad_red * tl.load(row + layout.RED)
            gain += grad_green * tl.load(row + layout.GREEN)
            gain += grad_blue * tl.load(row + layout.BLUE)
            if HAS_DEPTH:
                gain += grad_z * tl.load(row + layout.DEPTH)
            own = weight * gain
            v = tl.where(raw < constants.ALPHA_MAX, own - blended * (far * inverse), 0.0)
            far += own
            vu = v * u
            vy = v * dy
            sums = pair_sums + tl.load(pair_slots + place).to(tl.int64) * layout.PAIR_COLUMNS
            tl.store(sums + layout.SUM_V, tl.sum(v, axis=0))
            tl.store(sums + layout.SUM_VU, tl.sum(vu, axis=0))
            tl.store(sums + layout.SUM_VY, tl.sum(vy, axis=0))
            tl.store(sums + layout.SUM_VUU, tl.sum(vu * u, axis=0))
            tl.store(sums + layout.SUM_VUY, tl.sum(vu * dy, axis=0))
            tl.store(sums + layout.SUM_VYY, tl.sum(vy * dy, axis=0))
            tl.store(sums + layout.SUM_RED, tl.sum(weight * grad_red, axis=0))
            tl.store(sums + layout.SUM_GREEN, tl.sum(weight * grad_green, axis=0))
            tl.store(sums + layout.SUM_BLUE, tl.sum(weight * grad_blue, axis=0))
            if HAS_DEPTH:
                tl.store(sums + layout.SUM_DEPTH, tl.sum(weight * grad_z, axis=0))
