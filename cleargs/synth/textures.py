"""Seeded, periodic textures with detail at every scale, so that SIFT finds the room's surfaces."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

SIZE = 512
"""Side of the finest mip level, in texels."""
TEXELS_PER_METRE = 256.0
LEVELS = 8


@dataclass(frozen=True)
class TextureSet:
    """Mip chains of all textures in one flat array, as the ray caster reads them."""

    texels: NDArray[np.float32]  # [sum of SIZE^2 / 4^level over textures and levels, 3], linear RGB
    level_offsets: NDArray[np.int64]  # [LEVELS] start of a level inside one texture
    stride: int
    """Texels of one texture, all levels together."""


def _noise(rng: np.random.Generator, slope: float, stretch: float = 1.0) -> NDArray[np.float64]:
    """Periodic 1/f^slope noise of zero mean and unit deviation; ``stretch`` > 1 draws it out along x."""
    frequency_y = np.fft.fftfreq(SIZE)[:, None]
    frequency_x = np.fft.rfftfreq(SIZE)[None, :] * stretch
    radius = np.hypot(frequency_x, frequency_y)
    radius[0, 0] = np.inf
    spectrum = np.fft.rfft2(rng.standard_normal((SIZE, SIZE))) / radius**slope
    noise = np.fft.irfft2(spectrum, (SIZE, SIZE))
    return np.asarray(noise / noise.std(), np.float64)


def _mix(
    mask: NDArray[np.float64], low: NDArray[np.float64], high: NDArray[np.float64]
) -> NDArray[np.float64]:
    return low + (high - low) * mask[..., None]


def _surface(rng: np.random.Generator) -> NDArray[np.float64]:
    """Plaster, cloth or wood: two tones blended by noise, with fine grain and darker blotches."""
    base = rng.uniform(0.25, 0.75, 3)
    stretch = rng.choice([1.0, 1.0, 8.0])
    tone = 1 / (1 + np.exp(-2.5 * _noise(rng, 1.1, stretch)))
    blotch = (_noise(rng, 0.9) > 1.1).astype(np.float64)
    texture = _mix(tone, base * rng.uniform(0.4, 0.7), np.clip(base * rng.uniform(1.1, 1.4), 0, 0.95))
    texture = _mix(0.7 * blotch, texture, texture * rng.uniform(0.2, 0.6, 3))
    return texture * (1 + 0.12 * _noise(rng, 0.3)[..., None])


def _print(rng: np.random.Generator) -> NDArray[np.float64]:
    """A poster: rectangles, discs, strokes and letter-like marks on a tinted ground, wrapped at the edges."""
    canvas = np.empty((SIZE, SIZE, 3), np.uint8)
    canvas[:] = rng.integers(128, 240, 3)
    for _ in range(140):
        size = float(SIZE * np.exp(rng.uniform(np.log(0.015), np.log(0.22))))
        centre = rng.uniform(0, SIZE, 2)
        colour = tuple(int(v) for v in rng.integers(5, 240, 3))
        shape = rng.integers(4)
        patch = np.roll(canvas, tuple((SIZE // 2 - centre).astype(int)), (1, 0)).copy()
        middle = (SIZE // 2, SIZE // 2)
        if shape == 0:
            cv2.circle(patch, middle, max(int(size / 2), 1), colour, -1, cv2.LINE_AA)
        elif shape == 1:
            box = cv2.boxPoints((middle, (size, size * rng.uniform(0.2, 1)), rng.uniform(0, 180)))
            cv2.fillConvexPoly(patch, box.astype(np.int32), colour, cv2.LINE_AA)
        elif shape == 2:
            end = tuple(int(SIZE // 2 + v) for v in rng.uniform(-size, size, 2))
            cv2.line(patch, middle, end, colour, max(int(size / 12), 1), cv2.LINE_AA)
        else:
            letter = chr(int(rng.integers(ord("A"), ord("Z") + 1)))
            cv2.putText(patch, letter, middle, cv2.FONT_HERSHEY_DUPLEX, size / 40, colour, 2, cv2.LINE_AA)
        canvas = np.roll(patch, tuple((centre - SIZE // 2).astype(int)), (1, 0))
    return canvas / 255 * (1 + 0.05 * _noise(rng, 0.5)[..., None])


def make_textures(rng: np.random.Generator, surfaces: int, prints: int) -> TextureSet:
    """``surfaces`` material textures followed by ``prints`` posters, with box-filtered mip levels."""
    images = [_surface(rng) for _ in range(surfaces)] + [_print(rng) for _ in range(prints)]
    chains, offsets, offset = [], [], 0
    for level in range(LEVELS):
        offsets.append(offset)
        offset += (SIZE >> level) ** 2
    for image in images:
        current = np.clip(image, 0.01, 0.98)
        for _ in range(LEVELS):
            chains.append(current.reshape(-1, 3).astype(np.float32))
            current = (current[::2, ::2] + current[1::2, ::2] + current[::2, 1::2] + current[1::2, 1::2]) / 4
    return TextureSet(np.concatenate(chains), np.array(offsets, np.int64), offset)
