"""Measures of one frame: directional blur, noise, blocking, ringing, double images and exposure.

Blur is measured per direction from the fine detail that is left. The source is the re-blur ratio of Zhuo and
Sim, "Defocus map estimation from a single image" (Pattern Recognition 2011), here averaged over a tile.

T(sigma) is the mean structure tensor of the image after a Gaussian of standard deviation sigma. The energy of
the derivative along u is u' T(sigma) u. For sharp content it is proportional to sigma^-2p (p = 1/2 for step
edges, 1 for fine texture). A blur of standard deviation s along u makes it proportional to
(sigma^2 + s^2)^-p. The ratio of the energies at two scales does not depend on contrast and gives s if p is
known. p is estimated from sharper frames of the same content. A motion of length L blurs along one direction
(s = L / sqrt(12)); defocus blurs along all.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import cv2
import numpy as np

from cleargs.media.image import reduced
from cleargs.types import ArrayF64, ImageU8, MaskBool, MaskU8, PlaneF32

LONG_SIDE = 640
"""Long side, px, to which larger images are reduced. Blur is measured in pixels of the reduced image."""

DIRECTIONS = 8
"""Number of directions over 180 degrees. A motion is at most 11 degrees from one of them, so that the measure
keeps 98 % of its length.
"""
FINE, COARSE = 1.0, 3.0
"""Standard deviations, px, of the two scales. Finer scales measure noise; coarser ones mix several edges."""
MAX_SIGMA = 6.0
"""Largest blur, px, that the ratio of the two scales can measure."""

TILE = 40
"""Side of a tile, px. All tiles have the same weight, since parallax and roll blur a frame unevenly, and a
mean over all pixels would mostly measure the parts with the strongest contrast."""

_NOISE_GAIN = 0.2  # standard deviation of a derivative at sigma = 1 per that of white noise: 1 / sqrt(8 pi)
_MIN_ENERGY = 1.0  # squared levels per pixel, coarse scale; a tile with less has no structure
_MIN_VISIBLE_SHARE = 0.25  # minimum share of valid pixels in a tile that is measured
_MARGIN = 13  # px: support of the coarse scale (four standard deviations) and of the difference

_LAPLACIAN_DIFFERENCE = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], dtype=np.float32)
_MAD_TO_SIGMA = 1.4826  # standard deviation of a normal distribution per median absolute deviation
_BLOCK = 8  # px: JPEG and most video codecs transform blocks of 8 x 8
_DARK, _BRIGHT = 4.0, 251.0  # levels of 255: sRGB luma up to the first and from the second is clipped
_STRONG_EDGE = 200.0  # Sobel response, levels of 255: a step of 50
_MIN_PIXELS = 200  # minimum number of pixels for a quantile
_TILE = 256  # px: side of the tiles of the cepstrum
_NEAREST_LAG = 5  # px: at smaller lags content hides the peak of a double image


@dataclass(frozen=True)
class Luminance:
    """Rec.601 luma of an sRGB image, 0 to 255."""

    full: PlaneF32  # [H, W] as given
    reduced: PlaneF32  # [h, w] long side at most LONG_SIDE
    valid: MaskBool  # [h, w] False for masked pixels


def reduce_luminance(
    rgb: ImageU8,  # [H, W, 3] sRGB
    mask: MaskU8 | None,  # [H, W], 0 = ignore
) -> Luminance:
    """Return the luma in full and reduced size. A reduced pixel is valid if all its source pixels are."""
    full = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY).astype(np.float32)
    small = reduced(full, LONG_SIDE)
    if mask is None:
        return Luminance(full, small, np.ones(small.shape, dtype=bool))
    return Luminance(full, small, reduced((mask > 0).astype(np.float32), LONG_SIDE) > 0.999)


def erode_valid(valid: MaskBool, radius: int) -> MaskBool:
    """Return the pixels whose square neighbourhood of ``radius`` px is valid and inside the image."""
    kernel = np.ones((2 * radius + 1, 2 * radius + 1), dtype=np.uint8)
    eroded = cv2.erode(valid.astype(np.uint8), kernel, borderType=cv2.BORDER_CONSTANT, borderValue=0)
    return np.asarray(eroded > 0)


def detail_ratios(
    luminance: PlaneF32,  # [h, w] luma, 0 to 255
    valid: MaskBool,  # [h, w] pixels to measure
    noise: float,  # standard deviation of the noise, levels of 255; its energy is subtracted
) -> ArrayF64:  # [DIRECTIONS]
    """Return the mean over the tiles of u' T(FINE) u / u' T(COARSE) u per direction k pi / DIRECTIONS.

    It is about 3 for sharp step edges, up to 9 for fine texture, closer to 1 for stronger blur, and 0 without
    structure along a direction. Failure modes: soft content (shadows, clouds, out-of-focus background) looks
    like blur; `statistics` therefore compares with neighbouring frames. Dense noise or grain in dark areas
    looks like detail if `noise_level` misses it.
    """
    inner = erode_valid(valid, _MARGIN)
    share = _tile_means(inner.astype(np.float32))
    fine, coarse = (_directional_energy(luminance, inner, share, noise, sigma) for sigma in (FINE, COARSE))
    measured = (share > _MIN_VISIBLE_SHARE)[:, None] & (coarse > _MIN_ENERGY)
    ratio = np.clip(fine / np.where(measured, coarse, 1.0), 1.0, (COARSE / FINE) ** 2)
    counts = np.count_nonzero(measured, axis=0)
    return np.where(counts > 0, np.sum(ratio, axis=0, where=measured) / np.maximum(counts, 1), 0.0)


def _directional_energy(
    luminance: PlaneF32, inner: MaskBool, share: ArrayF64, noise: float, sigma: float
) -> ArrayF64:  # [tiles, DIRECTIONS]
    """Return u' T(sigma) u of each tile, in squared levels per pixel."""
    smooth = cv2.GaussianBlur(luminance, (0, 0), sigma)
    x, y = (0.5 * cv2.Sobel(smooth, cv2.CV_32F, dx, 1 - dx, ksize=1) * inner for dx in (1, 0))
    xx, xy, yy = (
        _tile_means(a * b) / np.maximum(share, _MIN_VISIBLE_SHARE) for a, b in ((x, x), (x, y), (y, y))
    )
    white = (_NOISE_GAIN * noise / sigma**2) ** 2
    angle = np.pi * np.arange(DIRECTIONS) / DIRECTIONS
    cos, sin = np.cos(angle), np.sin(angle)
    return np.asarray(
        np.outer(xx - white, cos**2) + np.outer(2.0 * xy, cos * sin) + np.outer(yy - white, sin**2)
    )


def _tile_means(plane: PlaneF32) -> ArrayF64:  # [h, w] -> [tiles]
    height, width = plane.shape
    size = max(1, round(width / TILE)), max(1, round(height / TILE))
    return cv2.resize(plane, size, interpolation=cv2.INTER_AREA).astype(np.float64).ravel()


def blur_sigmas(
    ratio: ArrayF64,  # [...] as `detail_ratios`
    content: ArrayF64,  # [...] > 1, ratios of sharp frames of the same content
) -> ArrayF64:  # [...] px, in [0, MAX_SIGMA]
    """Return the standard deviation s of the blur.

    Solve ratio = ((COARSE^2 + s^2) / (FINE^2 + s^2))^p, where ``content`` gives p at s = 0.
    """
    p = np.log(content) / np.log(COARSE**2 / FINE**2)
    quotient = np.maximum(ratio, 1.0) ** (1.0 / p)
    square = (COARSE**2 - quotient * FINE**2) / np.maximum(quotient - 1.0, 1e-6)
    return np.asarray(np.sqrt(np.clip(square, 0.0, MAX_SIGMA**2)))


def noise_level(luminance: PlaneF32, valid: MaskBool) -> float:
    """Return the standard deviation of the noise, in levels of 255.

    Source: Immerkaer's operator ("Fast noise variance estimation", CVIU 1996), which is 0 on linear ramps.
    Here the median replaces the mean, over the half of the unclipped pixels with the smallest gradient at a
    coarser scale. Failure modes: dense texture everywhere looks like noise; noise that the camera or the
    codec has smoothed is missed.
    """
    response = np.abs(cv2.filter2D(luminance, cv2.CV_32F, _LAPLACIAN_DIFFERENCE)) / 6.0
    smooth = cv2.GaussianBlur(luminance, (0, 0), 2.0)
    slope = np.abs(cv2.Sobel(smooth, cv2.CV_32F, 1, 0, ksize=1)) + np.abs(
        cv2.Sobel(smooth, cv2.CV_32F, 0, 1, ksize=1)
    )
    usable = erode_valid(valid, 4) & (smooth > _DARK) & (smooth < _BRIGHT)
    if not usable.any():
        return 0.0
    flat = response[usable & (slope <= np.median(slope[usable]))]
    return _MAD_TO_SIGMA * float(np.median(flat))


def blocking(luminance: PlaneF32) -> float:
    """Return the strength of steps on an 8 px grid relative to other steps: 0 if equal, 1 if twice as strong.

    After Wang, Bovik and Evans ("Blind measurement of blocking artifacts", ICIP 2000), in the pixel domain:
    the median absolute third difference of each column (and row) is averaged per phase modulo 8. The largest
    phase is divided by the median one. Use the image in full size. Failure modes: blocks in a resampled
    (undistorted or resized) frame are missed; a regular pattern with the same period looks like blocks.
    """
    strengths = []
    for plane in (luminance, luminance.T):
        step = np.abs(plane[:, 3:] - 3.0 * plane[:, 2:-1] + 3.0 * plane[:, 1:-2] - plane[:, :-3])
        # Median per column: the border of blocks covers the whole column, the edge of an object does not.
        profile = np.median(step[:, : step.shape[1] // _BLOCK * _BLOCK], axis=0)
        if profile.size:
            phases = np.sort(profile.reshape(-1, _BLOCK).mean(axis=0))
            strengths.append(float(phases[-1] / max(phases[_BLOCK // 2], 0.5) - 1.0))
    return max(strengths, default=0.0)


def ringing(luminance: PlaneF32, valid: MaskBool, noise: float) -> float:
    """Return the strength of ripples next to strong edges, in levels of 255 above the noise.

    This is the response of Immerkaer's operator at 3 to 5 px from strong edges, less the noise level. The
    lower quartile excludes texture next to an edge. Codecs and over-sharpening cause such ripples (mosquito
    noise). Failure mode: edges inside dense texture.
    """
    x, y = cv2.Sobel(luminance, cv2.CV_32F, 1, 0, ksize=3), cv2.Sobel(luminance, cv2.CV_32F, 0, 1, ksize=3)
    strong = (cv2.magnitude(x, y) > _STRONG_EDGE).astype(np.uint8)
    near, far = (cv2.dilate(strong, np.ones((2 * r + 1, 2 * r + 1), dtype=np.uint8)) for r in (2, 5))
    band = (far > 0) & (near == 0) & erode_valid(valid, 6)
    if np.count_nonzero(band) < _MIN_PIXELS:
        return 0.0
    response = np.abs(cv2.filter2D(luminance, cv2.CV_32F, _LAPLACIAN_DIFFERENCE)) / 6.0
    # For white noise the lower quartile of |x| is 0.319 standard deviations.
    return max(float(np.quantile(response[band], 0.25)) / 0.319 - noise, 0.0)


def exposure(luminance: PlaneF32, valid: MaskBool) -> tuple[float, float, float]:
    """Return mean luma, share of clipped pixels, and 95th less 5th percentile of luma, all in [0, 1].

    They are those of the valid pixels; (0, 1, 0) if there are none.
    """
    levels = luminance[valid]
    if not levels.size:
        return 0.0, 1.0, 0.0
    low, high = np.quantile(levels, [0.05, 0.95])
    clipped = float(np.mean((levels <= _DARK) | (levels >= _BRIGHT)))
    return float(np.mean(levels, dtype=np.float64)) / 255.0, clipped, float(high - low) / 255.0


def ghosting(luminance: PlaneF32, noise: float) -> float:
    """Return the height of the largest positive side peak of the power cepstrum.

    It is below 0.06 for single images, and 0.1 to 0.3 for a double image of about equal parts.

    The cepstrum (Bogert, Healy and Tukey 1963, for echoes) is the inverse transform of the log spectrum. A
    second image at displacement d multiplies the spectrum by |1 + a exp(i w d)|^2, which adds a positive peak
    at lag d. A motion blur of length d adds a negative peak, and content adds a smooth hill around lag 0. The
    mean of the log spectra of overlapping tiles suppresses the content, which differs between tiles. Lags
    are from _NEAREST_LAG px to almost a quarter of a tile. Failure modes: periodic content (tiles, stripes,
    fences) also has peaks, which neighbouring frames share; masked pixels are included.
    """
    size = min(_TILE, *luminance.shape)
    reach = size // 4
    if reach <= _NEAREST_LAG:
        return 0.0
    window = np.outer(np.hanning(size), np.hanning(size)).astype(np.float32)
    energy = float(np.sum(np.square(window, dtype=np.float64)))
    floor = (noise**2 + 1.0 / 12.0) * energy  # 1 / 12: variance of rounding
    spectrum = np.zeros((size, size // 2 + 1))
    starts = []
    for length in luminance.shape:  # tiles overlap by about a half
        count = max(1, round(2.0 * (length - size) / size) + 1)
        starts.append([round(k * (length - size) / max(1, count - 1)) for k in range(count)])
    places = list(product(*starts))
    for y, x in places:
        tile = luminance[y : y + size, x : x + size]
        power = np.abs(np.fft.rfft2((tile - tile.mean(dtype=np.float64)) * window)) ** 2
        spectrum += np.log(power + 4.0 * floor)
    cepstrum = np.fft.irfft2(spectrum / len(places), s=(size, size))
    cepstrum = np.roll(cepstrum, (reach, reach), axis=(0, 1))[: 2 * reach + 1, : 2 * reach + 1]
    smooth = cv2.GaussianBlur(cepstrum, (0, 0), 3.0)
    offset = np.arange(2 * reach + 1) - reach
    distance = np.hypot(offset[:, None], offset[None, :])
    lags = (distance >= _NEAREST_LAG) & (distance <= reach - 4)  # without the rim, where smoothing is biased
    return max(float((cepstrum - smooth)[lags].max()), 0.0)
