"""Gates that a repair must pass before it supervises: it must agree with the frame image or with the render.

Blur moves light by a few pixels, but it changes neither the place of content nor its mean colour. Every block
of a correct repair is therefore at its place in the frame image O_t or in the render R_t, and has the colours
of one of the two. The scorers cannot check this, because they see one image at a time.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from cleargs.base_model import FrozenModel
from cleargs.media.colour import linear_from_srgb, srgb_from_linear
from cleargs.types import ArrayF64, ImageF32

BLOCK = 64
"""Side of the blocks that are compared, px."""
ALIGNED_EVERY, COLOUR_EVERY = 32, 16
"""Distance between the starts of neighbouring blocks, px, in the checks of places and of colours."""
REACH = 8
"""Longest shift that is searched along each axis, px."""

_FLAT = 0.02  # a block of lower standard deviation has too little texture to be aligned
_AT_REST = 0.8  # see `_lengths`


class GateConfig(FrozenModel):
    """Limits of the disagreement of a repair with both frame image and render (docs/experiments/rivr.md)."""

    max_share: float = Field(
        0.1, ge=0.0, le=1.0, description="share of the blocks that may disagree; 1: no repair is refused"
    )
    max_shift: float = Field(0.6, ge=0.0, description="a block disagrees when it is further out of place, px")
    max_colour: float = Field(
        0.06, ge=0.0, description="or when its mean light differs by more in any channel, in sRGB"
    )


def rejection_reason(
    repair: ImageF32, observed: ImageF32, render: ImageF32, limits: GateConfig
) -> str | None:
    """Return the reason to refuse ``repair`` [H, W, 3] of a frame; None if it may supervise.

    Masked pixels must be the same in all three images (`candidates.hide_masked`).
    """
    if limits.max_share >= 1.0:
        return None
    misplaced = float((shifts(repair, observed, render) > limits.max_shift).mean())
    if misplaced > limits.max_share:
        return f"{misplaced:.0%} of its blocks out of place"
    discoloured = float((colour_differences(repair, observed, render) > limits.max_colour).mean())
    if discoloured > limits.max_share:
        return f"{discoloured:.0%} of its blocks off colour"
    return None


def shifts(repair: ImageF32, observed: ImageF32, render: ImageF32) -> ArrayF64:
    """Return the distance of each block from its place in the nearer of O_t and R_t, px [rows, columns].

    It is 0 for a block with too little texture.
    """
    found = []
    for row in zip(*(_rows(image) for image in (repair, observed, render)), strict=True):
        lengths = np.zeros(len(row[0]))
        textured = row[0].std(axis=(1, 2)) > _FLAT
        if textured.any():
            spectra, *references = (_spectra(blocks[textured]) for blocks in row)
            side = row[0].shape[1]
            lengths[textured] = np.minimum(*(_lengths(spectra * other.conj(), side) for other in references))
        found.append(lengths)
    return np.stack(found)


def colour_differences(repair: ImageF32, observed: ImageF32, render: ImageF32) -> ArrayF64:
    """Return the difference of each block's mean from that of the nearer of O_t and R_t, [rows, columns].

    It is that of the channel with the largest difference, in sRGB.
    """
    means, *references = (_block_means(image) for image in (repair, observed, render))
    nearer: ArrayF64 = np.minimum(*(np.abs(means - other).max(axis=2) for other in references))
    return nearer


def _block_means(image: ImageF32) -> ArrayF64:
    """Return means in sRGB [rows, columns, 3], computed in linear light, which blur keeps."""
    linear = linear_from_srgb(image).astype(np.float64)
    height, width, _ = linear.shape
    side = min(BLOCK, height, width)
    strips = np.stack([linear[y : y + side].mean(axis=0) for y in _starts(height, side, COLOUR_EVERY)])
    means = [strips[:, x : x + side].mean(axis=1) for x in _starts(width, side, COLOUR_EVERY)]
    return srgb_from_linear(np.stack(means, axis=1))


def _rows(image: ImageF32) -> Iterator[ArrayF64]:
    """Yield the grey blocks of each row, [N, S, S]: S is `BLOCK`, or the shorter side of the image."""
    grey = image.mean(axis=2, dtype=np.float64)
    height, width = grey.shape
    side = min(BLOCK, height, width)
    for y in _starts(height, side, ALIGNED_EVERY):
        starts = _starts(width, side, ALIGNED_EVERY)
        yield np.stack([grey[y : y + side, x : x + side] for x in starts])


def _starts(length: int, side: int, step: int) -> list[int]:
    """Return the first pixels of the blocks along an axis; the last block ends with the image."""
    return sorted({*range(0, length - side + 1, step), length - side})


def _spectra(blocks: ArrayF64) -> NDArray[np.complex128]:
    window = np.hanning(blocks.shape[1])
    centred = blocks - blocks.mean(axis=(1, 2), keepdims=True)
    return np.fft.rfft2(centred * window[:, None] * window)


def _lengths(cross: NDArray[np.complex128], side: int) -> ArrayF64:
    """Return the length of each block's shift, px, from its cross-power spectrum [N, S, S // 2 + 1].

    This is phase correlation with half whitening. With full whitening, the noise that blur leaves at high
    frequencies would hide the peak. Without whitening, the peak would be broad. A symmetric blur of either
    image does not move the peak. A parabola through the peak and its neighbours gives fractions of a pixel. A
    lone edge makes a ridge, whose highest point is random: if the correlation without a shift is nearly as
    high (`_AT_REST`), the shift is 0.
    """
    correlation = np.fft.irfft2(cross / np.sqrt(np.abs(cross) + 1e-9), (side, side))
    reach = min(REACH, side // 2 - 1)
    near = np.arange(-reach - 1, reach + 2)
    around = correlation[:, near[:, None], near]
    inner = around[:, 1:-1, 1:-1].reshape(len(around), -1)
    y, x = np.divmod(inner.argmax(axis=1), 2 * reach + 1)
    k = np.arange(len(around))
    peak = around[k, y + 1, x + 1]
    dy = _fraction(around[k, y, x + 1], peak, around[k, y + 2, x + 1])
    dx = _fraction(around[k, y + 1, x], peak, around[k, y + 1, x + 2])
    lengths = np.hypot(y - reach + dy, x - reach + dx)
    return np.where(correlation[:, 0, 0] < _AT_REST * peak, lengths, 0.0)


def _fraction(before: ArrayF64, peak: ArrayF64, after: ArrayF64) -> ArrayF64:
    """Return the offset of the peak of a parabola through three samples from the middle one, at most 0.5."""
    bend = before - 2.0 * peak + after
    offset = np.divide(0.5 * (before - after), bend, out=np.zeros_like(bend), where=bend < 0.0)
    return np.clip(offset, -0.5, 0.5)
