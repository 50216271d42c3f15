"""L1 + D-SSIM and its gradient in two passes over the image, and squared errors.

SSIM (Wang et al. 2004) as in the Inria code: 11 x 11 Gaussian window G with sigma 1.5, zero padding,
C1 = 0.01², C2 = 0.03², channels treated separately, and the mean over all values. With the window means
m = G*x, n = G*y, p = G*x², q = G*y², r = G*(xy),

    A1 = 2 m n + C1,   A2 = 2 (r - m n) + C2,   B1 = m² + n² + C1,   B2 = (p - m²) + (q - n²) + C2
    S  = A1 A2 / (B1 B2)
    dS/dm = 2 [ n (A2 - A1) + m S (B1 - B2) ] / (B1 B2),   dS/dp = -S / B2,   dS/dr = 2 A1 / (B1 B2)
    d(sum of S)/dx = G*(dS/dm) + 2 x G*(dS/dp) + y G*(dS/dr)

because G is symmetric. The window is separable: each output row needs eleven input rows, summed
vertically into row buffers and then horizontally. Rows are thus independent work items, and no intermediate
image of the five means is stored.

Images are copied once into padded rows: 16 zeros, 3 W interleaved values, zeros to a multiple of `LANES`, and
16 more. Neighbouring pixels are then three floats apart, and windows need no border checks. Masked pixels are
zero in both images, so that they act like the padding outside the image.

Sums are in float64, within each row and then over the rows in their order.
"""

from __future__ import annotations

import numpy as np
from numba import prange

from cleargs.splat import constants
from cleargs.splat.kernels.cpu.jit import inlined, kernel
from cleargs.splat.kernels.cpu.simd import LANES, broadcast, load, magnitude, select, store
from cleargs.types import AnyArray, ArrayF32

RADIUS = constants.SSIM_RADIUS
TAPS = 2 * RADIUS + 1
C1, C2 = np.float32(constants.SSIM_C1), np.float32(constants.SSIM_C2)
ZERO, ONE, TWO = np.float32(0), np.float32(1), np.float32(2)
CHANNELS = 3
PAD = 16
"""Zeros at each end of a padded row: at least RADIUS pixels of three channels."""

# Indices of the row buffers of window means, and of the derivative maps.
MEAN_X, MEAN_Y, MEAN_XX, MEAN_YY, MEAN_XY = range(5)
BY_MEAN, BY_SQUARE, BY_PRODUCT = range(3)


def ssim_window() -> ArrayF32:
    """Return the normalised one-dimensional window, [11]."""
    weights = np.exp(-(np.arange(-RADIUS, RADIUS + 1) ** 2) / (2 * constants.SSIM_SIGMA**2))
    window: ArrayF32 = (weights / weights.sum()).astype(np.float32)
    return window


def padded_length(width: int) -> int:
    """Return the number of floats in a padded row."""
    return -(-CHANNELS * width // LANES) * LANES + 2 * PAD


@kernel
def pad_images(
    image: ArrayF32,
    target: ArrayF32,
    mask: AnyArray | None,
    padded_image: ArrayF32,
    padded_target: ArrayF32,
    counted: ArrayF32,
) -> None:
    """Copy both images [H, W, 3] into padded rows; ``counted`` becomes 1 for values that count, else 0."""
    height, width, _ = image.shape
    for y in prange(height):
        padded_image[y, :] = ZERO
        padded_target[y, :] = ZERO
        counted[y, :] = ZERO
        for x in range(width):
            if mask is not None and not mask[y, x]:
                continue
            for channel in range(CHANNELS):
                i = PAD + CHANNELS * x + channel
                padded_image[y, i] = image[y, x, channel]
                padded_target[y, i] = target[y, x, channel]
                counted[y, i] = ONE


@inlined
def vertical_means(y: int, image: ArrayF32, target: ArrayF32, window: ArrayF32, rows: ArrayF32) -> None:
    """Write the five window sums over the rows around ``y`` into the row buffers."""
    height, length = image.shape
    first, last = max(0, y - RADIUS), min(height - 1, y + RADIUS)
    for i in range(PAD, length - PAD, LANES):
        sum_x = sum_y = sum_xx = sum_yy = sum_xy = broadcast(ZERO)
        for source in range(first, last + 1):
            weight = window[source - y + RADIUS]
            a = load(image, source * length + i)
            b = load(target, source * length + i)
            weighted_a = a * weight
            weighted_b = b * weight
            sum_x = sum_x + weighted_a
            sum_y = sum_y + weighted_b
            sum_xx = sum_xx + weighted_a * a
            sum_yy = sum_yy + weighted_b * b
            sum_xy = sum_xy + weighted_a * b
        store(rows, MEAN_X * length + i, sum_x)
        store(rows, MEAN_Y * length + i, sum_y)
        store(rows, MEAN_XX * length + i, sum_xx)
        store(rows, MEAN_YY * length + i, sum_yy)
        store(rows, MEAN_XY * length + i, sum_xy)


@inlined
def row_total(values: ArrayF32, length: int) -> float:
    """Return the sum of a row buffer in float64, without the padding."""
    total = 0.0
    for i in range(PAD, length - PAD):
        total += np.float64(values[i])
    return total


@kernel
def measure(
    image: ArrayF32, target: ArrayF32, counted: ArrayF32, window: ArrayF32, maps: ArrayF32, row_sums: AnyArray
) -> None:
    """Write the sums of |x - y|, of SSIM and of counted values in each padded row, [H, 3] float64.

    ``maps`` [3, H, length] receives the derivatives of SSIM by the window means; its padding is not written.
    """
    height, length = image.shape
    for y in prange(height):
        rows = np.zeros((5, length), np.float32)
        values = np.empty(length, np.float32)
        for i in range(PAD, length - PAD, LANES):
            difference = load(image, y * length + i) - load(target, y * length + i)
            store(values, i, magnitude(difference))
        row_sums[y, 0] = row_total(values, length)
        vertical_means(y, image, target, window, rows)
        for i in range(PAD, length - PAD, LANES):
            m = n = p = q = r = broadcast(ZERO)
            for tap in range(TAPS):
                weight = window[tap]
                j = i + CHANNELS * (tap - RADIUS)
                m = m + load(rows, MEAN_X * length + j) * weight
                n = n + load(rows, MEAN_Y * length + j) * weight
                p = p + load(rows, MEAN_XX * length + j) * weight
                q = q + load(rows, MEAN_YY * length + j) * weight
                r = r + load(rows, MEAN_XY * length + j) * weight
            mn = m * n
            squares = m * m + n * n
            a1 = TWO * mn + C1
            a2 = TWO * (r - mn) + C2
            b1 = squares + C1
            b2 = (p + q - squares) + C2
            inverse = ONE / (b1 * b2)
            similarity = a1 * a2 * inverse
            counts = load(counted, y * length + i)
            store(values, i, similarity * counts)
            scale = inverse * counts
            by_mean = TWO * (n * (a2 - a1) + m * similarity * (b1 - b2)) * scale
            store(maps, (BY_MEAN * height + y) * length + i, by_mean)
            store(maps, (BY_SQUARE * height + y) * length + i, ZERO - similarity * b1 * scale)
            store(maps, (BY_PRODUCT * height + y) * length + i, TWO * a1 * scale)
        row_sums[y, 1] = row_total(values, length)
        row_sums[y, 2] = row_total(counted[y], length)


@kernel
def differentiate(
    image: ArrayF32,
    target: ArrayF32,
    counted: ArrayF32,
    window: ArrayF32,
    maps: ArrayF32,
    l1_scale: np.float32,
    ssim_scale: np.float32,
    gradient: ArrayF32,
) -> None:
    """Write l1_scale sign(x - y) + ssim_scale d(sum of SSIM)/dx, [H, W, 3], zero in masked pixels."""
    height, length = image.shape
    width = gradient.shape[1]
    for y in prange(height):
        rows = np.zeros((3, length), np.float32)
        values = np.empty(length, np.float32)
        first, last = max(0, y - RADIUS), min(height - 1, y + RADIUS)
        for i in range(PAD, length - PAD, LANES):
            by_mean = by_square = by_product = broadcast(ZERO)
            for source in range(first, last + 1):
                weight = window[source - y + RADIUS]
                by_mean = by_mean + load(maps, (BY_MEAN * height + source) * length + i) * weight
                by_square = by_square + load(maps, (BY_SQUARE * height + source) * length + i) * weight
                by_product = by_product + load(maps, (BY_PRODUCT * height + source) * length + i) * weight
            store(rows, BY_MEAN * length + i, by_mean)
            store(rows, BY_SQUARE * length + i, by_square)
            store(rows, BY_PRODUCT * length + i, by_product)
        plus, minus, zero = broadcast(l1_scale), broadcast(-l1_scale), broadcast(ZERO)
        for i in range(PAD, length - PAD, LANES):
            by_mean = by_square = by_product = zero
            for tap in range(TAPS):
                weight = window[tap]
                j = i + CHANNELS * (tap - RADIUS)
                by_mean = by_mean + load(rows, BY_MEAN * length + j) * weight
                by_square = by_square + load(rows, BY_SQUARE * length + j) * weight
                by_product = by_product + load(rows, BY_PRODUCT * length + j) * weight
            a = load(image, y * length + i)
            b = load(target, y * length + i)
            sign = select(a > b, plus, select(a < b, minus, zero))
            similarity = by_mean + TWO * a * by_square + b * by_product
            store(values, i, (sign + similarity * ssim_scale) * load(counted, y * length + i))
        for x in range(width):
            for channel in range(CHANNELS):
                gradient[y, x, channel] = values[PAD + CHANNELS * x + channel]


@kernel
def squared_errors(image: ArrayF32, target: ArrayF32, mask: AnyArray | None, row_sums: AnyArray) -> None:
    """Write the sum of squared differences and the number of values in each row, [H, 2] float64."""
    height, width, channels = image.shape
    for y in prange(height):
        total = 0.0
        count = 0
        for x in range(width):
            if mask is None or mask[y, x]:
                count += channels
                for channel in range(channels):
                    difference = np.float64(image[y, x, channel]) - np.float64(target[y, x, channel])
                    total += difference * difference
        row_sums[y, 0] = total
        row_sums[y, 1] = count
