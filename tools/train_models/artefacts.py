"""Simulated artefacts of sharpening, restoration and splatting on photos.

With the blur, noise and JPEG of ``degrade``, they train the no-reference scorer. RIVR uses the scorer to rank
renders of a Gaussian scene, restored frames and fusions of the two.

Inputs and outputs are images [H, W, 3], float32 sRGB in [0, 1]. All random choices come from ``rng``.
"""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from cleargs.media.colour import linear_from_srgb, srgb_from_linear
from cleargs.types import ImageF32
from tools.train_models.degrade import Degradation, Kernel, degrade, disc_kernel, jpeg, motion_kernel


def unsharp(image: ImageF32, sigma: float, amount: float) -> ImageF32:
    """Apply unsharp masking: I + amount (I - blur_sigma(I)). Amounts above about 1 oversharpen."""
    return _clip(image + amount * (image - _gaussian(image, sigma)))


def gibbs(image: ImageF32, cutoff: float, gain: float) -> ImageF32:
    """Add ringing by an abrupt low-pass filter.

    Args:
        image: The image.
        cutoff: Cut-off frequency, cycles per pixel (0 to 0.5).
        gain: Gain just below the cut-off, at least 1.
    """
    f = _frequency(image.shape[0] * 2, image.shape[1] * 2)
    response = np.where(f <= cutoff, 1.0 + (gain - 1.0) * (f / cutoff) ** 2, 0.0)
    return _filter(image, response)


def wiener(image: ImageF32, kernel: Kernel, noise_to_signal: float) -> ImageF32:
    """Apply Wiener deconvolution to the sRGB values.

    With a wrong kernel or a small ``noise_to_signal`` it adds ringing, as strong restorers do.

    Args:
        image: The image.
        kernel: Blur kernel with odd sides, not larger than the image.
        noise_to_signal: Ratio of the power of noise and signal.
    """
    padded = np.zeros((image.shape[0] * 2, image.shape[1] * 2), np.float64)
    radius = kernel.shape[0] // 2
    padded[: kernel.shape[0], : kernel.shape[1]] = kernel
    transfer = np.fft.rfft2(np.roll(padded, (-radius, -radius), axis=(0, 1)))
    return _filter(image, np.conj(transfer) / (np.abs(transfer) ** 2 + noise_to_signal))


def ghost(image: ImageF32, dx: float, dy: float, share: float) -> ImageF32:
    """Blend the image with a copy shifted by (dx, dy) px that has ``share`` of the linear light."""
    linear = linear_from_srgb(image)
    shift = np.array([[1, 0, dx], [0, 1, dy]], np.float32)
    size = (image.shape[1], image.shape[0])
    moved = cv2.warpAffine(linear, shift, size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT_101)
    return srgb_from_linear(_clip((1.0 - share) * linear + share * moved))


def splat(image: ImageF32, rng: np.random.Generator, spacing: float, stretch: float) -> ImageF32:
    """Approximate the image by about one anisotropic Gaussian per ``spacing``² pixels.

    Gaussians follow local edges and have random sizes. A second pass splats the residual of the first, like
    an optimisation. High frequencies are lost unevenly, and edges look like brush strokes.

    Args:
        image: The image.
        rng: Random generator.
        spacing: Mean distance between Gaussians, px.
        stretch: Maximum elongation.
    """
    tensor = [_gaussian(t, 1.5) for t in _structure(image)]
    height, width = image.shape[:2]
    count = int(height * width / spacing**2)
    out = np.zeros_like(image)
    for _ in range(2):
        x = rng.uniform(0, width, count)
        y = rng.uniform(0, height, count)
        column, row = x.astype(np.int64), y.astype(np.int64)
        xx, xy, yy = (t[row, column] for t in tensor)
        along = 0.5 * np.arctan2(2 * xy, xx - yy) + np.pi / 2 + rng.normal(0.0, 0.2, count)
        anisotropy = np.sqrt((xx - yy) ** 2 + 4 * xy**2) / (xx + yy + 1e-6)
        size = spacing * rng.lognormal(-0.35, 0.35, count)
        elongation = 1.0 + (stretch - 1.0) * anisotropy * rng.random(count)
        footprint = np.stack([x, y, along, size * np.sqrt(elongation), size / np.sqrt(elongation)], axis=1)
        residual = image - out
        colours = _gaussian(residual, 0.4 * spacing)[row, column]
        out = out + _splat_mean(footprint, colours, height, width)
    return _clip(out)


def floaters(image: ImageF32, rng: np.random.Generator, count: int, needle_share: float) -> ImageF32:
    """Draw ``count`` stray Gaussians over the image: soft blobs, and needles for ``needle_share`` of them."""
    out = image.copy()
    height, width = image.shape[:2]
    for _ in range(count):
        if rng.random() < needle_share:
            major, minor = rng.uniform(6.0, 30.0), rng.uniform(0.4, 1.2)
        else:
            major = rng.uniform(2.0, 14.0)
            minor = major * rng.uniform(0.3, 1.0)
        footprint = np.array(
            [rng.uniform(0, width), rng.uniform(0, height), rng.uniform(0, np.pi), major, minor]
        )
        source = image[rng.integers(height), rng.integers(width)]
        colour = np.clip(source + rng.normal(0.0, 0.15, 3), 0.0, 1.0).astype(np.float32)
        window, weight = _footprint(footprint, height, width)
        alpha = (rng.uniform(0.2, 0.95) * weight)[..., None].astype(np.float32)
        out[window] += alpha * (colour - out[window])
    return out


def fuse(render: ImageF32, restored: ImageF32, sigma: float) -> ImageF32:
    """Return RIVR's fused candidate: clip(R + D - blur_sigma(D)), with render R and restored frame D."""
    return _clip(render + restored - _gaussian(restored, sigma))


def motion(image: ImageF32, rng: np.random.Generator) -> ImageF32:
    """Add motion blur of 1.5-20 px and sensor noise of at most 1/255."""
    kernel = motion_kernel(rng, _log_uniform(rng, 1.5, 20.0))
    return degrade(image, Degradation(kernel, noise=rng.uniform(0.0, 1.0 / 255.0)), rng)


def defocus(image: ImageF32, rng: np.random.Generator) -> ImageF32:
    """Add disc or Gaussian blur with a radius of 0.6-6 px."""
    radius = _log_uniform(rng, 0.6, 6.0)
    if rng.random() < 0.5:
        return _gaussian(image, 0.6 * radius)
    return degrade(image, Degradation(disc_kernel(radius)), rng)


def noise(image: ImageF32, rng: np.random.Generator) -> ImageF32:
    """Add white or slightly smoothed (demosaicked) noise of 2-32/255."""
    level = _log_uniform(rng, 2.0, 32.0) / 255.0
    grain = rng.standard_normal(image.shape, np.float32)
    if rng.random() < 0.4:
        grain = _gaussian(grain, rng.uniform(0.4, 1.0))
        grain /= grain.std()
    return _clip(image + np.float32(level) * grain)


def ringing(image: ImageF32, rng: np.random.Generator) -> ImageF32:
    """Add Gibbs ringing, or deconvolve a sharp image by a kernel that did not blur it."""
    if rng.random() < 0.5:
        return gibbs(image, rng.uniform(0.12, 0.4), rng.uniform(1.0, 2.5))
    kernel = (
        motion_kernel(rng, rng.uniform(2.0, 9.0))
        if rng.random() < 0.5
        else disc_kernel(rng.uniform(0.8, 3.0))
    )
    return wiener(image, kernel, _log_uniform(rng, 0.01, 0.3))


def oversharp(image: ImageF32, rng: np.random.Generator) -> ImageF32:
    """Apply unsharp masking, from barely visible to harsh."""
    return unsharp(image, _log_uniform(rng, 0.6, 4.0), _log_uniform(rng, 0.4, 5.0))


def ghosting(image: ImageF32, rng: np.random.Generator) -> ImageF32:
    """Add one or two faint copies, shifted by 2-16 px."""
    for _ in range(int(rng.integers(1, 3))):
        angle, distance = rng.uniform(0, 2 * np.pi), _log_uniform(rng, 2.0, 16.0)
        image = ghost(image, distance * np.cos(angle), distance * np.sin(angle), rng.uniform(0.12, 0.5))
    return image


def blocks(image: ImageF32, rng: np.random.Generator) -> ImageF32:
    """Apply JPEG compression of quality 8-80."""
    return jpeg(image, int(_log_uniform(rng, 8.0, 80.0)))


def rendered(image: ImageF32, rng: np.random.Generator) -> ImageF32:
    """Imitate a splat render: too few Gaussians, uneven density, stray Gaussians in front."""
    out = splat(image, rng, _log_uniform(rng, 2.2, 7.0), rng.uniform(1.5, 8.0))
    if rng.random() < 0.5:
        share = patches(image.shape[0], image.shape[1], rng)
        out = out + share * (_gaussian(image, rng.uniform(0.3, 4.0)) - out)
    if rng.random() < 0.5:
        out = floaters(out, rng, int(rng.integers(1, 12)), rng.random())
    return out


def stray(image: ImageF32, rng: np.random.Generator) -> ImageF32:
    """Add floaters and needles to a sharp or slightly soft image."""
    soft = _gaussian(image, rng.uniform(0.2, 1.2)) if rng.random() < 0.6 else image
    return floaters(soft, rng, int(_log_uniform(rng, 2.0, 40.0)), rng.random())


def restored(image: ImageF32, rng: np.random.Generator) -> ImageF32:
    """Blur the image and restore it: too weakly, about right, or with ringing."""
    length = rng.uniform(2.0, 14.0)
    kernel = motion_kernel(rng, length) if rng.random() < 0.7 else disc_kernel(length / 4)
    blurred = degrade(image, Degradation(kernel, noise=rng.uniform(0.0, 1.0 / 255.0)), rng)
    if rng.random() < 0.4:
        return unsharp(blurred, _log_uniform(rng, 0.8, 4.0), _log_uniform(rng, 0.3, 3.0))
    return wiener(blurred, kernel, _log_uniform(rng, 0.001, 0.1))


def fused(image: ImageF32, rng: np.random.Generator) -> ImageF32:
    """Fuse a splat-like render with the detail of a restored frame, sometimes slightly misaligned."""
    detail = restored(image, rng)
    if rng.random() < 0.4:
        shift = np.array([[1, 0, rng.normal(0, 1.5)], [0, 1, rng.normal(0, 1.5)]], np.float32)
        detail = cv2.warpAffine(
            detail, shift, (image.shape[1], image.shape[0]), borderMode=cv2.BORDER_REFLECT_101
        ).astype(np.float32)
    return fuse(rendered(image, rng), detail, _log_uniform(rng, 0.8, 5.0))


def mixed(image: ImageF32, rng: np.random.Generator) -> ImageF32:
    """Apply two or three of the other artefacts in random order."""
    names = rng.choice(len(_SIMPLE), size=int(rng.integers(2, 4)), replace=False)
    for index in names:
        image = _SIMPLE[int(index)](image, rng)
    return image


_SIMPLE: tuple[Callable[[ImageF32, np.random.Generator], ImageF32], ...] = (
    motion, defocus, noise, ringing, oversharp, ghosting, blocks, rendered, stray,
)  # fmt: skip

KINDS: dict[str, Callable[[ImageF32, np.random.Generator], ImageF32]] = {
    "clean": lambda image, rng: image,
    "motion": motion,
    "defocus": defocus,
    "noise": noise,
    "ringing": ringing,
    "oversharp": oversharp,
    "ghosting": ghosting,
    "blocks": blocks,
    "rendered": rendered,
    "stray": stray,
    "restored": restored,
    "fused": fused,
    "mixed": mixed,
}


def _clip(image: NDArray[np.floating]) -> ImageF32:
    return np.asarray(np.clip(image, 0.0, 1.0), np.float32)


def _log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def _gaussian(image: ImageF32, sigma: float) -> ImageF32:
    return np.asarray(cv2.GaussianBlur(image, (0, 0), sigma, borderType=cv2.BORDER_REFLECT_101), np.float32)


def _frequency(height: int, width: int) -> NDArray[np.float64]:
    return np.asarray(np.hypot(np.fft.fftfreq(height)[:, None], np.fft.rfftfreq(width)[None, :]), np.float64)


def _filter(image: ImageF32, response: NDArray[np.floating] | NDArray[np.complexfloating]) -> ImageF32:
    """Filter the mirrored image in the Fourier domain, so that its borders do not wrap around."""
    height, width = image.shape[:2]
    mirrored = np.pad(image, ((0, height), (0, width), (0, 0)), mode="symmetric")
    spectrum = np.fft.rfft2(mirrored, axes=(0, 1)) * response[..., None]
    return _clip(np.fft.irfft2(spectrum, s=mirrored.shape[:2], axes=(0, 1))[:height, :width])


def _structure(image: ImageF32) -> tuple[ImageF32, ImageF32, ImageF32]:
    luma = image.mean(axis=2)
    gx, gy = cv2.Sobel(luma, cv2.CV_32F, 1, 0), cv2.Sobel(luma, cv2.CV_32F, 0, 1)
    return gx * gx, gx * gy, gy * gy


def patches(height: int, width: int, rng: np.random.Generator) -> ImageF32:
    """Return a smooth random mask [H, W, 1] with values from 0 to 1."""
    coarse = rng.standard_normal((height, width), np.float32)
    field = _gaussian(coarse, rng.uniform(8.0, 32.0))
    return _clip(0.5 + field / (field.std() + 1e-9))[..., None]


def _footprint(
    gaussian: NDArray[np.float64],  # [5] x, y, angle of the major axis, deviations along major and minor axis
    height: int,
    width: int,
) -> tuple[tuple[slice, slice], NDArray[np.float64]]:
    """Return the window (rows, columns) of a Gaussian, 2.5 deviations, and its weights (1 at the centre)."""
    x, y, angle, major, minor = gaussian
    c, s = np.cos(angle), np.sin(angle)
    reach_x, reach_y = 2.5 * np.hypot(major * c, minor * s), 2.5 * np.hypot(major * s, minor * c)
    rows = slice(max(0, int(y - reach_y)), min(height, int(y + reach_y) + 1))
    columns = slice(max(0, int(x - reach_x)), min(width, int(x + reach_x) + 1))
    dy = np.arange(rows.start, rows.stop)[:, None] + 0.5 - y
    dx = np.arange(columns.start, columns.stop)[None, :] + 0.5 - x
    u, v = (c * dx + s * dy) / major, (c * dy - s * dx) / minor
    return (rows, columns), np.exp(-0.5 * (u * u + v * v))


@njit(cache=True)  # NumPy needs half a second per patch
def _splat_mean(
    gaussians: NDArray[np.float64],  # [N, 5] as in _footprint
    colours: ImageF32,  # [N, 3]
    height: int,
    width: int,
) -> ImageF32:
    """Return the weighted mean of the Gaussians' colours at each pixel [H, W, 3]."""
    total = np.zeros((height, width, 3), np.float64)
    weights = np.full((height, width, 1), 1e-6)
    for n in range(gaussians.shape[0]):
        x, y, angle, major, minor = gaussians[n]
        c, s = np.cos(angle), np.sin(angle)
        reach_x, reach_y = 2.5 * np.hypot(major * c, minor * s), 2.5 * np.hypot(major * s, minor * c)
        for row in range(max(0, int(y - reach_y)), min(height, int(y + reach_y) + 1)):
            for column in range(max(0, int(x - reach_x)), min(width, int(x + reach_x) + 1)):
                dx, dy = column + 0.5 - x, row + 0.5 - y
                u, v = (c * dx + s * dy) / major, (c * dy - s * dx) / minor
                weight = np.exp(-0.5 * (u * u + v * v))
                weights[row, column, 0] += weight
                for channel in range(3):
                    total[row, column, channel] += weight * colours[n, channel]
    mean: ImageF32 = (total / weights).astype(np.float32)
    return mean
