"""L1 + D-SSIM and its gradient in four passes over the image.

The mathematics is that of the CPU back end's ``loss``. The 11 x 11 window of SSIM is separable.
``window_rows`` sums x, y, x², y² and xy along the rows. ``measure`` sums the results along the columns, which
gives the similarity and its derivatives by the window means. ``window_maps`` and ``differentiate`` do the
same with the derivatives. ``window_maps`` also adds the sums of ``measure``. An image row is 3 W interleaved
values, so that neighbours in a channel are three values apart. Masked pixels are zero in both images, as are
pixels outside the image. A value that is brighter than a saturated target counts as equal to it.

Each program stores its sums in float64 at a separate place. One program adds them in a fixed order.
"""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from cleargs.splat import constants
from cleargs.splat.kernels.cuda import device_layout
from cleargs.splat.kernels.cuda.device_layout import LOSS_COLUMNS, LOSS_ROWS
from cleargs.splat.kernels.cuda.support import memory_errors


@triton.jit
def places(height, length):
    """Return the rows and the places in them that a program handles, and the mask of those in the image."""
    y = tl.program_id(1) * device_layout.LOSS_ROWS + tl.arange(0, device_layout.LOSS_ROWS)[:, None]
    i = tl.program_id(0) * device_layout.LOSS_COLUMNS + tl.arange(0, device_layout.LOSS_COLUMNS)[None, :]
    return y, i, (y < height) & (i < length)


@triton.jit
def zeros():
    shape: tl.constexpr = [device_layout.LOSS_ROWS, device_layout.LOSS_COLUMNS]
    return tl.zeros(shape, tl.float32)


@triton.jit
def compared(image, target, mask, saturated, y, j, inside, length, HAS_MASK: tl.constexpr):
    """Return both images at row y, place j, zero outside and where masked, and the mask of values to clip."""
    value = tl.load(image + y * length + j, mask=inside, other=0.0)
    goal = tl.load(target + y * length + j, mask=inside, other=0.0)
    too_bright = (goal >= saturated) & (value > goal)
    value = tl.where(too_bright, goal, value)
    if HAS_MASK:
        counts = tl.load(mask + y * (length // 3) + j // 3, mask=inside, other=0)
        value, goal = tl.where(counts != 0, value, 0.0), tl.where(counts != 0, goal, 0.0)
    return value, goal, too_bright


@triton.jit
def sum_of_rows(plane, y, i, height, length):
    """Return the window sums of a plane [H, length] over the rows around y."""
    total = zeros()
    for tap in tl.static_range(11):
        row = y + (tap - 5)
        inside = (row >= 0) & (row < height) & (i < length)
        total += tl.load(plane + row * length + i, mask=inside, other=0.0) * device_layout.SSIM_WINDOW[tap]
    return total


@triton.jit(do_not_specialize=["height", "length"])
def window_rows(image, target, mask, saturated, sums, height, length, HAS_MASK: tl.constexpr):
    """Store the window sums of x, y, x², y² and xy along the rows: ``sums`` [5, H, length]."""
    y, i, here = places(height, length)
    mean_x, mean_y, mean_xx, mean_yy, mean_xy = zeros(), zeros(), zeros(), zeros(), zeros()
    for tap in tl.static_range(11):
        j = i + 3 * (tap - 5)
        inside = (y < height) & (j >= 0) & (j < length)
        a, b, _ = compared(image, target, mask, saturated, y, j, inside, length, HAS_MASK)
        weighted_a = a * device_layout.SSIM_WINDOW[tap]
        weighted_b = b * device_layout.SSIM_WINDOW[tap]
        mean_x += weighted_a
        mean_y += weighted_b
        mean_xx += weighted_a * a
        mean_yy += weighted_b * b
        mean_xy += weighted_a * b
    plane = height.to(tl.int64) * length
    at = sums + y * length + i
    tl.store(at, mean_x, mask=here)
    tl.store(at + plane, mean_y, mask=here)
    tl.store(at + 2 * plane, mean_xx, mask=here)
    tl.store(at + 3 * plane, mean_yy, mask=here)
    tl.store(at + 4 * plane, mean_xy, mask=here)


@triton.jit(do_not_specialize=["height", "length"])
def measure(image, target, mask, saturated, sums, maps, partials, height, length, HAS_MASK: tl.constexpr):
    """Store the derivatives of SSIM by the window means, ``maps`` [3, H, length], and sums [programs, 4]."""
    y, i, here = places(height, length)
    plane = height.to(tl.int64) * length
    m, n = sum_of_rows(sums, y, i, height, length), sum_of_rows(sums + plane, y, i, height, length)
    p = sum_of_rows(sums + 2 * plane, y, i, height, length)
    q = sum_of_rows(sums + 3 * plane, y, i, height, length)
    r = sum_of_rows(sums + 4 * plane, y, i, height, length)
    a, b, _ = compared(image, target, mask, saturated, y, i, here, length, HAS_MASK)
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


@triton.jit
def add_partials(partials, totals, count):
    """Store the sums over the ``count`` rows of ``partials`` [count, 4]."""
    row = tl.arange(0, device_layout.LOSS_SUMS)[:, None]
    column = tl.arange(0, 4)[None, :]
    total = tl.zeros_like(row + column).to(tl.float64)
    for first in range(0, count, device_layout.LOSS_SUMS):
        at = partials + (first + row) * 4 + column
        total += tl.load(at, mask=(first + row < count) & (column < 4), other=0.0)
    tl.store(totals + tl.arange(0, 4), tl.sum(total, axis=0))


@triton.jit(do_not_specialize=["height", "length"])
def window_maps(maps, sums, partials, totals, height, length):
    """Store the window sums of one of the three maps along the rows: ``sums`` [3, H, length].

    The first program also adds the ``partials`` of ``measure``, while others run: ``totals`` [4].
    """
    if tl.program_id(0) + tl.program_id(1) + tl.program_id(2) == 0:
        add_partials(partials, totals, tl.num_programs(0) * tl.num_programs(1))
    y, i, here = places(height, length)
    plane = tl.program_id(2) * height.to(tl.int64) * length
    total = zeros()
    for tap in tl.static_range(11):
        j = i + 3 * (tap - 5)
        inside = (y < height) & (j >= 0) & (j < length)
        value = tl.load(maps + plane + y * length + j, mask=inside, other=0.0)
        total += value * device_layout.SSIM_WINDOW[tap]
    tl.store(sums + plane + y * length + i, total, mask=here)


@triton.jit(do_not_specialize=["height", "length"])
def differentiate(
    image,
    target,
    mask,
    saturated,
    sums,
    totals,
    gradient,
    l1_weight,
    ssim_weight,
    height,
    length,
    HAS_MASK: tl.constexpr,
):
    """Store (l1_weight sign(x - y) + ssim_weight d(sum of SSIM)/dx) / count; 0 where masked or too bright."""
    y, i, here = places(height, length)
    plane = height.to(tl.int64) * length
    by_mean = sum_of_rows(sums, y, i, height, length)
    by_square = sum_of_rows(sums + plane, y, i, height, length)
    by_product = sum_of_rows(sums + 2 * plane, y, i, height, length)
    a, b, too_bright = compared(image, target, mask, saturated, y, i, here, length, HAS_MASK)
    share = (1.0 / tl.maximum(tl.load(totals + 3), 1.0)).to(tl.float32)
    sign = tl.where(a > b, 1.0, tl.where(a < b, -1.0, 0.0))
    slope = by_mean + 2.0 * a * by_square + b * by_product
    value = tl.where(too_bright, 0.0, (l1_weight * sign + ssim_weight * slope) * share)
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
    saturated: float,
    gradient: Tensor,
) -> Tensor:
    """See ``cleargs.splat.backend.Backend``. The sums stay on the device."""
    size = height, length = image.shape[0], 3 * image.shape[1]
    sums, maps = (torch.empty(planes * height * length, device=image.device) for planes in (5, 3))
    grid = (-(-length // LOSS_COLUMNS), -(-height // LOSS_ROWS))
    partials = torch.empty(grid[0] * grid[1], 4, dtype=torch.float64, device=image.device)
    totals = torch.empty(4, dtype=torch.float64, device=image.device)
    bits = image if mask is None else mask.contiguous().view(torch.uint8)
    images = image.detach().contiguous(), target.contiguous(), bits, saturated
    options = {"HAS_MASK": mask is not None, "num_warps": 4}
    window_rows[grid](*images, sums, *size, **options)
    measure[grid](*images, sums, maps, partials, *size, **options)
    window_maps[(*grid, 3)](maps, sums, partials, totals, *size, num_warps=4)
    differentiate[grid](*images, sums, totals, gradient, l1_weight, ssim_weight, *size, **options)
    return totals
