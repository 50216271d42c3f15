"""Degradations other than blur: noise, blocking, ringing, exposure and double images."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from cleargs.rva.luminance import Mask, Plane, away_from_masked

_LAPLACIAN_DIFFERENCE = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], dtype=np.float32)
_MAD_TO_SIGMA = 1.4826
_BLOCK = 8  # px: JPEG and most video codecs transform blocks of 8
_DARK, _BRIGHT = 4.0, 251.0  # levels at and beyond which an sRGB luma counts as clipped
_STRONG_EDGE = 200.0  # Sobel response, levels of 255: a step of 50
_MIN_PIXELS = 200  # fewer do not make a quantile
_TILE = 256  # px
_NEAREST_LAG = 5  # px: nearer, content hides the peak of a double image


def noise_level(luminance: Plane, valid: Mask) -> float:
    """Standard deviation of the noise, in levels of 255.

    Immerkaer's operator ("Fast noise variance estimation", CVIU 1996), which cancels ramps, with a median in
    place of the mean, over the half of the unclipped pixels that is smoothest at a coarser scale. Failure
    modes: dense texture everywhere reads as noise; noise that the camera or the codec has smoothed away reads
    as none.
    """
    response = np.abs(cv2.filter2D(luminance, cv2.CV_32F, _LAPLACIAN_DIFFERENCE)) / 6.0
    smooth = cv2.GaussianBlur(luminance, (0, 0), 2.0)
    slope = np.abs(cv2.Sobel(smooth, cv2.CV_32F, 1, 0, ksize=1)) + np.abs(
        cv2.Sobel(smooth, cv2.CV_32F, 0, 1, ksize=1)
    )
    usable = away_from_masked(valid, 4) & (smooth > _DARK) & (smooth < _BRIGHT)
    if not usable.any():
        return 0.0
    flat = response[usable & (slope <= np.median(slope[usable]))]
    return _MAD_TO_SIGMA * float(np.median(flat))


def blocking(luminance: Plane) -> float:
    """Excess of the steps on an 8 px grid over those between its lines; 0 for none, 1 for twice as strong.

    After Wang, Bovik and Evans ("Blind measurement of blocking artifacts", ICIP 2000), in the pixel domain:
    the median absolute third difference of each column (and row), averaged by phase modulo 8, the largest
    phase over the median one. Measured on the image as given. Failure mode: undistortion and resizing bend
    the grid away, so that blocks in a resampled frame go unseen; a regular pattern of the same period reads
    as blocks.
    """
    strengths = []
    for plane in (luminance, luminance.T):
        step = np.abs(plane[:, 3:] - 3.0 * plane[:, 2:-1] + 3.0 * plane[:, 1:-2] - plane[:, :-3])
        # The median over each column: a block border runs along all of it, an object's edge does not.
        profile = np.median(step[:, : step.shape[1] // _BLOCK * _BLOCK], axis=0)
        if profile.size:
            phases = np.sort(profile.reshape(-1, _BLOCK).mean(axis=0))
            strengths.append(float(phases[-1] / max(phases[_BLOCK // 2], 0.5) - 1.0))
    return max(strengths, default=0.0)


def ringing(luminance: Plane, valid: Mask, noise: float) -> float:
    """Ripple beside strong edges over what is there farther away, in levels of 255 beyond the noise.

    The response of Immerkaer's operator at 3 to 5 px from strong edges, as its lower quartile there (texture
    that happens to lie beside an edge is not ringing), less the noise level. Codecs and over-sharpening leave
    such ripples (mosquito noise). Failure mode: edges inside dense texture.
    """
    x, y = cv2.Sobel(luminance, cv2.CV_32F, 1, 0, ksize=3), cv2.Sobel(luminance, cv2.CV_32F, 0, 1, ksize=3)
    strong = (cv2.magnitude(x, y) > _STRONG_EDGE).astype(np.uint8)
    near, far = (cv2.dilate(strong, np.ones((2 * r + 1, 2 * r + 1), dtype=np.uint8)) for r in (2, 5))
    band = (far > 0) & (near == 0) & away_from_masked(valid, 6)
    if np.count_nonzero(band) < _MIN_PIXELS:
        return 0.0
    response = np.abs(cv2.filter2D(luminance, cv2.CV_32F, _LAPLACIAN_DIFFERENCE)) / 6.0
    # For white noise the lower quartile of |x| is 0.319 standard deviations.
    return max(float(np.quantile(response[band], 0.25)) / 0.319 - noise, 0.0)


@dataclass(frozen=True)
class Exposure:
    """How a frame uses the range of levels."""

    mean: float
    """Mean luma over 255."""
    clipped: float
    """Share of the pixels at black or white."""
    spread: float
    """From the 5th to the 95th percentile of the luma, over 255."""


def exposure(luminance: Plane, valid: Mask) -> Exposure:
    """Brightness, clipping and contrast of the pixels that count. All zero and clipped where none does."""
    levels = luminance[valid]
    if not levels.size:
        return Exposure(mean=0.0, clipped=1.0, spread=0.0)
    low, high = np.quantile(levels, [0.05, 0.95])
    return Exposure(
        mean=float(np.mean(levels, dtype=np.float64)) / 255.0,
        clipped=float(np.mean((levels <= _DARK) | (levels >= _BRIGHT))),
        spread=float(high - low) / 255.0,
    )


def ghosting(luminance: Plane, noise: float) -> float:
    """Height of the largest positive side peak of the power cepstrum: below 0.06 for none,
    0.1 to 0.3 for a double image of about equal parts.

    The cepstrum (Bogert, Healy and Tukey 1963: made for echoes) is the inverse transform of the log spectrum.
    A second image at displacement d multiplies the spectrum by |1 + a exp(i w d)|^2 and puts a positive peak
    at lag d; a motion blur of length d puts a negative one there, and content a smooth hill around lag 0. The
    log spectra of overlapping tiles are averaged, since what they share is the system and what they do not is
    the content. Lags from _NEAREST_LAG px to nearly a quarter of a tile. Failure modes: periodic content
    (tiles, stripes, fences) has peaks of its own, which neighbouring frames share; masked pixels take part.
    """
    size = min(_TILE, *luminance.shape)
    reach = size // 4
    if reach <= _NEAREST_LAG:
        return 0.0
    window = np.outer(np.hanning(size), np.hanning(size)).astype(np.float32)
    floor = (noise**2 + 1.0 / 12.0) * float(
        np.sum(np.square(window, dtype=np.float64))
    )  # rounding is noise as well
    spectrum = np.zeros((size, size // 2 + 1))
    for y in _tile_starts(luminance.shape[0], size):
        for x in _tile_starts(luminance.shape[1], size):
            tile = luminance[y : y + size, x : x + size]
            power = np.abs(np.fft.rfft2((tile - tile.mean(dtype=np.float64)) * window)) ** 2
            spectrum += np.log(power + 4.0 * floor)
    count = len(_tile_starts(luminance.shape[0], size)) * len(_tile_starts(luminance.shape[1], size))
    cepstrum = np.fft.irfft2(spectrum / count, s=(size, size))
    cepstrum = np.roll(cepstrum, (reach, reach), axis=(0, 1))[: 2 * reach + 1, : 2 * reach + 1]
    smooth = cv2.GaussianBlur(cepstrum, (0, 0), 3.0)
    offset = np.arange(2 * reach + 1) - reach
    distance = np.hypot(offset[:, None], offset[None, :])
    lags = (distance >= _NEAREST_LAG) & (distance <= reach - 4)  # the smoothed rim is no background
    return max(float((cepstrum - smooth)[lags].max()), 0.0)


def _tile_starts(length: int, size: int) -> list[int]:
    """Starts of tiles that cover ``length`` with about half a tile of overlap."""
    count = max(1, round(2.0 * (length - size) / size) + 1)
    return [round(k * (length - size) / max(1, count - 1)) for k in range(count)]
