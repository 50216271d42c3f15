"""Measures of one frame: blur by direction, noise, blocking, ringing, double images and exposure.

Blur is read from what is left of fine detail, direction by direction.
Source: the re-blur ratio of Zhuo and Sim, "Defocus map estimation from a single image" (Pattern Recognition
2011), taken over all pixels of a tile and along directions. With T(sigma) the mean structure tensor of the
image smoothed by a Gaussian of standard deviation sigma, u' T(sigma) u is the energy of the derivative along
u. For content whose energy goes as sigma^-2p (p = 1/2 for step edges, 1 for fine texture) under a blur of
standard deviation s along u it goes as (sigma^2 + s^2)^-p. The ratio of the energies at two scales therefore
gives s whatever the contrast, once p is known, and p is what sharper views of the same content tell. A motion
of length L acts along its own direction only, where s = L / sqrt(12), while defocus acts along all.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import cv2
import numpy as np

from cleargs.rva.evaluator import reduced
from cleargs.types import ArrayF64, ImageU8, MaskBool, MaskU8, PlaneF32

LONG_SIDE = 640
"""Images are reduced (never enlarged) to this long side: blur is measured in pixels of that size."""

DIRECTIONS = 8
"""Directions over half a turn: a motion is at most 11 degrees away from one, where it keeps 98 % of its
length.
"""
FINE, COARSE = 1.0, 3.0
"""Standard deviations, px, of the two scales. Finer is noise; coarser mixes neighbouring edges."""
MAX_EXTENT = 6.0
"""Extents, px, beyond which the ratio of the two scales says nothing more."""

TILE = 40
"""px: parallax and roll blur a frame unevenly, so each tile is measured and each counts the same; over all
pixels at once the parts of strongest contrast would speak for the whole."""

_NOISE_GAIN = 0.2  # standard deviation of a derivative at sigma = 1 over that of white noise: 1 / sqrt(8 pi)
_MIN_ENERGY = 1.0  # squared levels a pixel, at the coarse scale: a tile with less has no structure
_MIN_VISIBLE_SHARE = 0.25  # of a tile's pixels; with fewer in view it is not measured
_MARGIN = 13  # px: the support of the coarse scale, four deviations and the difference

_LAPLACIAN_DIFFERENCE = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], dtype=np.float32)
_MAD_TO_SIGMA = 1.4826
_BLOCK = 8  # px: JPEG and most video codecs transform blocks of 8
_DARK, _BRIGHT = 4.0, 251.0  # levels at and beyond which an sRGB luma counts as clipped
_STRONG_EDGE = 200.0  # Sobel response, levels of 255: a step of 50
_MIN_PIXELS = 200  # fewer do not make a quantile
_TILE = 256  # px
_NEAREST_LAG = 5  # px: nearer, content hides the peak of a double image


@dataclass(frozen=True)
class Luminance:
    """Rec.601 luma of an sRGB image, 0 to 255."""

    full: PlaneF32  # [H, W] as given
    reduced: PlaneF32  # [h, w] long side at most LONG_SIDE
    valid: MaskBool  # [h, w] not masked


def reduce_luminance(
    rgb: ImageU8,  # [H, W, 3] sRGB
    mask: MaskU8 | None,  # [H, W], 0 = ignore
) -> Luminance:
    """Luma as given, and reduced by area averaging; a reduced pixel counts if all that it averages does."""
    full = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY).astype(np.float32)
    small = reduced(full, LONG_SIDE)
    if mask is None:
        return Luminance(full, small, np.ones(small.shape, dtype=bool))
    return Luminance(full, small, reduced((mask > 0).astype(np.float32), LONG_SIDE) > 0.999)


def away_from_masked(valid: MaskBool, radius: int) -> MaskBool:
    """Valid pixels at least ``radius`` (pixels, square neighbourhood) from masked ones and the border."""
    kernel = np.ones((2 * radius + 1, 2 * radius + 1), dtype=np.uint8)
    eroded = cv2.erode(valid.astype(np.uint8), kernel, borderType=cv2.BORDER_CONSTANT, borderValue=0)
    return np.asarray(eroded > 0)


def detail_ratios(
    luminance: PlaneF32, valid: MaskBool, noise: float
) -> ArrayF64:  # [h, w], [h, w] -> [DIRECTIONS]
    """Mean over the tiles of u' T(FINE) u / u' T(COARSE) u along each direction k pi / DIRECTIONS.

    The noise's own share is taken off; ``noise`` in levels of 255. About 3 for a sharp scene of step edges,
    up to 9 for fine texture, towards 1 the stronger the blur; 0 without structure along a direction: what
    cannot be seen to be sharp is not trusted.

    Failure modes: content that is soft by itself (shadows, clouds, out-of-focus background) reads as blur,
    which is what neighbouring frames of a video share, see `statistics`; dense noise or grain in the dark
    reads as detail where `degradations.noise_level` misses it.
    """
    inner = away_from_masked(valid, _MARGIN)
    share = _tile_means(inner.astype(np.float32))
    fine, coarse = (_directional_energy(luminance, inner, share, noise, sigma) for sigma in (FINE, COARSE))
    measured = (share > _MIN_VISIBLE_SHARE)[:, None] & (coarse > _MIN_ENERGY)
    ratio = np.clip(fine / np.where(measured, coarse, 1.0), 1.0, (COARSE / FINE) ** 2)
    counts = np.count_nonzero(measured, axis=0)
    return np.where(counts > 0, np.sum(ratio, axis=0, where=measured) / np.maximum(counts, 1), 0.0)


def _directional_energy(
    luminance: PlaneF32, inner: MaskBool, share: ArrayF64, noise: float, sigma: float
) -> ArrayF64:  # [tiles, DIRECTIONS]
    """u' T(sigma) u of each tile, in squared levels a pixel."""
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


def extents_from_ratios(
    ratio: ArrayF64,  # [...] as `detail_ratios`
    content: ArrayF64,  # [...] > 1: what sharp views of the same content have
) -> ArrayF64:  # [...] px, in [0, MAX_EXTENT]
    """Standard deviation s of the blur: solves ratio = ((COARSE^2 + s^2) / (FINE^2 + s^2))^p with the p that
    ``content`` has at s = 0.
    """
    p = np.log(content) / np.log(COARSE**2 / FINE**2)
    quotient = np.maximum(ratio, 1.0) ** (1.0 / p)
    square = (COARSE**2 - quotient * FINE**2) / np.maximum(quotient - 1.0, 1e-6)
    return np.asarray(np.sqrt(np.clip(square, 0.0, MAX_EXTENT**2)))


def noise_level(luminance: PlaneF32, valid: MaskBool) -> float:
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


def blocking(luminance: PlaneF32) -> float:
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


def ringing(luminance: PlaneF32, valid: MaskBool, noise: float) -> float:
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


def exposure(luminance: PlaneF32, valid: MaskBool) -> tuple[float, float, float]:
    """How the pixels that count use the range of levels, black and clipped where none counts.

    The mean luma over 255, the share of clipped pixels, and the 95th percentile less the 5th, over 255.
    """
    levels = luminance[valid]
    if not levels.size:
        return 0.0, 1.0, 0.0
    low, high = np.quantile(levels, [0.05, 0.95])
    clipped = float(np.mean((levels <= _DARK) | (levels >= _BRIGHT)))
    return float(np.mean(levels, dtype=np.float64)) / 255.0, clipped, float(high - low) / 255.0


def ghosting(luminance: PlaneF32, noise: float) -> float:
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
    energy = float(np.sum(np.square(window, dtype=np.float64)))
    floor = (noise**2 + 1.0 / 12.0) * energy  # rounding is noise as well
    spectrum = np.zeros((size, size // 2 + 1))
    starts = []
    for length in luminance.shape:  # tiles that overlap by about a half
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
    lags = (distance >= _NEAREST_LAG) & (distance <= reach - 4)  # the smoothed rim is no background
    return max(float((cepstrum - smooth)[lags].max()), 0.0)
