"""L1 + D-SSIM and its gradient in four passes over the image.

The mathematics is that of the CPU back end's ``loss``. The 11 x 11 window of SSIM is separable.
``window_rows`` sums x, y, x², y² and xy along the rows. ``measure`` sums the results along the columns, which
gives the similarity and its derivatives by the window means. ``window_maps`` and ``differentiate`` go the
same way with the derivatives. An image row is 3 W interleaved values, so that neighbours in a channel are
three values apart. Masked pixels are zero in both images, as are pixels outside the image.

Each program stores its sums in float64 at a separate place. torch adds them in a fixed order.
"""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from cleargs.splat import constants
from cleargs.splat.kernels.cuda import device_layout
from cleargs.splat.kernels.cuda.support import memory_errors

ROWS = 4
COLUMNS = 128
"""Rows, and values per row, of one program."""


@triton.jit
def kept(values, mask, y, j, inside, length, HAS_MASK: tl.constexpr):
    """Return the values at row y, place j: zero outside the image and where masked."""
    value = tl.load(values + y * length + j, mask=inside, other=0.0)
    if HAS_MASK:
        counts = tl.load(mask + y * (length // 3) + j // 3, mask=inside, other=0)
        value = tl.where(counts != 0, value, 0.0)
    return value


@triton.jit(do_not_specialize=["height", "length"])
def window_rows(
    image,
    target,
    mask,
    sums,
    height,
    length,
    HAS_MASK: tl.constexpr,
    ROWS: tl.constexpr,
    COLUMNS: tl.constexpr,
):
    """Store the window sums of x, y, x², y² and xy along the rows: ``sums`` [5, H, length]."""
    y = tl.program_id(1) * ROWS + tl.arange(0, ROWS)[:, None]
    i = tl.program_id(0) * COLUMNS + tl.arange(0, COLUMNS)[None, :]
    mean_x = tl.zeros([ROWS, COLUMNS], tl.float32)
    mean_y = tl.zeros([ROWS, COLUMNS], tl.float32)
    mean_xx = tl.zeros([ROWS, COLUMNS], tl.float32)
    mean_yy = tl.zeros([ROWS, COLUMNS], tl.float32)
    mean_xy = tl.zeros([ROWS, COLUMNS], tl.float32)
    for tap in tl.static_range(11):
        j = i + 3 * (tap - 5)
        inside = (y < height) & (j >= 0) & (j < length)
        a = kept(image, mask, y, j, inside, length, HAS_MASK)
        b = kept(target, mask, y, j, inside, length, HAS_MASK)
        weighted_a = a * device_layout.SSIM_WINDOW[tap]
        weighted_b = b * device_layout.SSIM_WINDOW[tap]
        mean_x += weighted_a
        mean_y += weighted_b
        mean_xx += weighted_a * a
        mean_yy += weighted_b * b
        mean_xy += weighted_a * b
    plane = height.to(tl.int64) * length
    at = sums + y * length + i
    here = (y < height) & (i < length)
    tl.store(at, mean_x, mask=here)
    tl.store(at + plane, mean_y, mask=here)
    tl.store(at + 2 * plane, mean_xx, mask=here)
    tl.store(at + 3 * plane, mean_yy, mask=here)
    tl.store(at + 4 * plane, mean_xy, mask=here)


@triton.jit(do_not_specialize=["height", "length"])
def measure(
    image,
    target,
    mask,
    sums,
    maps,
    partials,
    height,
    length,
    HAS_MASK: tl.constexpr,
    ROWS: tl.constexpr,
    COLUMNS: tl.constexpr,
):
    """Store the derivatives of SSIM by the window means, ``maps`` [3, H, length], and sums [programs, 4]."""
    y = tl.program_id(1) * ROWS + tl.arange(0, ROWS)[:, None]
    i = tl.program_id(0) * COLUMNS + tl.arange(0, COLUMNS)[None, :]
    here = (y < height) & (i < length)
    plane = height.to(tl.int64) * length
    m = tl.zeros([ROWS, COLUMNS], tl.float32)
    n = tl.zeros([ROWS, COLUMNS], tl.float32)
    p = tl.zeros([ROWS, COLUMNS], tl.float32)
    q = tl.zeros([ROWS, COLUMNS], tl.float32)
    r = tl.zeros([ROWS, COLUMNS], tl.float32)
    for tap in tl.static_range(11):
        row = y + (tap - 5)
        inside = (row >= 0) & (row < height) & (i < length)
        at = sums + row * length + i
        m += tl.load(at, mask=inside, other=0.0) * device_layout.SSIM_WINDOW[tap]
        n += tl.load(at + plane, mask=inside, other=0.0) * device_layout.SSIM_WINDOW[tap]
        p += tl.load(at + 2 * plane, mask=inside, other=0.0) * device_layout.SSIM_WINDOW[tap]
        q += tl.load(at + 3 * plane, mask=inside, other=0.0) * device_layout.SSIM_WINDOW[tap]
        r += tl.load(at + 4 * plane, mask=inside, other=0.0) * device_layout.SSIM_WINDOW[tap]
    a = kept(image, mask, y, i, here, length, HAS_MASK)
    b = kept(target, mask, y, i, here, length, HAS_MASK)
    counts = here.to(tl.float32)
    if HAS_MASK:
        counts = tl.load(mask + y * (length // 3) + i // 3, mask=here, other=0).to(tl.float32)
    mn = m * n
    squares = m * m + n * n
    a1 = 2.0 * mn + constants.SSIM_C1
    a2 = 2.0 * (r - mn) + constants.SSIM_C2
    b1 = squares + constants.SSIM_C1
    b2 = (p + q - squares) + constants.SSIM_C2
    inverse = 1.0 / (b1 * b2)
    similarity = a1 * a2 * inverse
    scale = inverse * counts
    at = maps + y * length + i
    tl.store(at, 2.0 * (n * (a2 - a1) + m * similarity * (b1 - b2)) * scale, mask=here)
    tl.store(at + plane, -similarity * b1 * scale, mask=here)
    tl.store(at + 2 * plane, 2.0 * a1 * scale, mask=here)
    difference = a - b
    place = partials + (tl.program_id(1) * tl.num_programs(0) + tl.program_id(0)) * 4
    tl.store(place, tl.sum(tl.sum(tl.abs(difference).to(tl.float64), axis=1), axis=0))
    tl.store(place + 1, tl.sum(tl.sum((similarity * counts).to(tl.float64), axis=1), axis=0))
    squared = difference.to(tl.float64) * difference.to(tl.float64)
    tl.store(place + 2, tl.sum(tl.sum(squared, axis=1), axis=0))
    tl.store(place + 3, tl.sum(tl.sum(counts.to(tl.float64), axis=1), axis=0))


@triton.jit(do_not_specialize=["height", "length"])
def window_maps(maps, sums, height, length, ROWS: tl.constexpr, COLUMNS: tl.constexpr):
    """Store the window sums of the three maps along the rows: ``sums`` [3, H, length]."""
    y = tl.program_id(1) * ROWS + tl.arange(0, ROWS)[:, None]
    i = tl.program_id(0) * COLUMNS + tl.arange(0, COLUMNS)[None, :]
    plane = height.to(tl.int64) * length
    by_mean = tl.zeros([ROWS, COLUMNS], tl.float32)
    by_square = tl.zeros([ROWS, COLUMNS], tl.float32)
    by_product = tl.zeros([ROWS, COLUMNS], tl.float32)
    for tap in tl.static_range(11):
        j = i + 3 * (tap - 5)
        inside = (y < height) & (j >= 0) & (j < length)
        at = maps + y * length + j
        by_mean += tl.load(at, mask=inside, other=0.0) * device_layout.SSIM_WINDOW[tap]
        by_square += tl.load(at + plane, mask=inside, other=0.0) * device_layout.SSIM_WINDOW[tap]
        by_product += tl.load(at + 2 * plane, mask=inside, other=0.0) * device_layout.SSIM_WINDOW[tap]
    at = sums + y * length + i
    here = (y < height) & (i < length)
    tl.store(at, by_mean, mask=here)
    tl.store(at + plane, by_square, mask=here)
    tl.store(at + 2 * plane, by_product, mask=here)


@triton.jit(do_not_specialize=["height", "length"])
def differentiate(
    image,
    target,
    mask,
    sums,
    totals,
    gradient,
    l1_weight,
    ssim_weight,
    height,
    length,
    HAS_MASK: tl.constexpr,
    ROWS: tl.constexpr,
    COLUMNS: tl.constexpr,
):
    """Store (l1_weight sign(x - y) + ssim_weight d(sum of SSIM)/dx) / count, and 0 where masked."""
    y = tl.program_id(1) * ROWS + tl.arange(0, ROWS)[:, None]
    i = tl.program_id(0) * COLUMNS + tl.arange(0, COLUMNS)[None, :]
    here = (y < height) & (i < length)
    plane = height.to(tl.int64) * length
    by_mean = tl.zeros([ROWS, COLUMNS], tl.float32)
    by_square = tl.zeros([ROWS, COLUMNS], tl.float32)
    by_product = tl.zeros([ROWS, COLUMNS], tl.float32)
    for tap in tl.static_range(11):
        row = y + (tap - 5)
        inside = (row >= 0) & (row < height) & (i < length)
        at = sums + row * length + i
        by_mean += tl.load(at, mask=inside, other=0.0) * device_layout.SSIM_WINDOW[tap]
        by_square += tl.load(at + plane, mask=inside, other=0.0) * device_layout.SSIM_WINDOW[tap]
        by_product += tl.load(at + 2 * plane, mask=inside, other=0.0) * device_layout.SSIM_WINDOW[tap]
    a = kept(image, mask, y, i, here, length, HAS_MASK)
    b = kept(target, mask, y, i, here, length, HAS_MASK)
    share = (1.0 / tl.maximum(tl.load(totals + 3), 1.0)).to(tl.float32)
    sign = tl.where(a > b, 1.0, tl.where(a < b, -1.0, 0.0))
    slope = by_mean + 2.0 * a * by_square + b * by_product
    value = (l1_weight * sign + ssim_weight * slope) * share
    if HAS_MASK:
        counts = tl.load(mask + y * (length // 3) + i // 3, mask=here, other=0)
        value = tl.where(counts != 0, value, 0.0)
    tl.store(gradient + y * length + i, value, mask=here)


@memory_errors()
def loss_sums(
    image: Tensor,
    target: Tensor,
    mask: Tensor | None,
    *,
    l1_weight: float,
    ssim_weight: float,
    gradient: Tensor,
) -> Tensor:
    """See ``cleargs.splat.backend.Backend``. The sums stay on the device."""
    height, length = image.shape[0], 3 * image.shape[1]
    sums, maps = (torch.empty(planes * height * length, device=image.device) for planes in (5, 3))
    grid = (-(-length // COLUMNS), -(-height // ROWS))
    partials = torch.empty(grid[0] * grid[1], 4, dtype=torch.float64, device=image.device)
    image, target = image.detach().contiguous(), target.contiguous()
    bits = image if mask is None else mask.contiguous().view(torch.uint8)
    block = {"ROWS": ROWS, "COLUMNS": COLUMNS, "num_warps": 4}
    has_mask = mask is not None
    window_rows[grid](image, target, bits, sums, height, length, HAS_MASK=has_mask, **block)
    measure[grid](image, target, bits, sums, maps, partials, height, length, HAS_MASK=has_mask, **block)
    totals = partials.sum(0)
    window_maps[grid](maps, sums, height, length, **block)
    differentiate[grid](
        image,
        target,
        bits,
        sums,
        totals,
        gradient,
        l1_weight,
        ssim_weight,
        height,
        length,
        HAS_MASK=has_mask,
        **block,
    )
    return totals
