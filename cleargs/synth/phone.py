"""Image processing of a phone: tone curve, sharpening, automatic exposure and video codec.

Tone curve and sharpening are the look of the camera, not a fault. The ground truth of a capture has them as
well. Effects of exposure and codec are in the frames only.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from cleargs.media.colour import LUMA, srgb_from_linear
from cleargs.media.encode import write_video
from cleargs.media.video import decode_frames, read_timeline
from cleargs.random_streams import Stream
from cleargs.types import ArrayF64, ImageU8

NOISE = 1.5 / 255
"""Standard deviation of the sensor noise at mid grey, sRGB units, for a phone's small pixels indoors."""
BITS_PER_PIXEL = 0.6
"""Mean rate of the video over a second. The PSNR of decoded frames is about 35 dB, so that artifacts are
visible as in a phone's video. A phone's video has 0.3 bits per pixel at 1080p, but its frames are larger and
closer in time."""
SHARPENING_SIGMA = 1.0
"""Standard deviation of the Gaussian of the unsharp mask, pixels of the image."""
SPOT_POWER = 8
"""Power of the sine window of the light meter. Most weight is in the middle third of each side."""
LAG_S = 0.6
"""Time constant of automatic exposure, seconds."""
METERING_SHARE = 0.8
"""Share of a change of brightness, in stops, that automatic exposure compensates in the end."""


@dataclass(frozen=True)
class Tone:
    """Look of a camera: an S-shaped tone curve, then an unsharp mask on luma. Both use sRGB values."""

    contrast: float = 0.0
    """Steepness of the logistic curve; 0: no curve."""
    pivot: float = 0.5
    """sRGB value in [0, 1] where the curve is steepest."""
    sharpening: float = 0.0
    """Factor of the luma's fine detail that is added to all channels."""

    def tone(self, value: ArrayF64) -> ArrayF64:
        """Apply the tone curve, which increases from 0 at 0 to 1 at 1."""
        if not self.contrast:
            return value
        low, high = (1 / (1 + math.exp(-self.contrast * (end - self.pivot))) for end in (0.0, 1.0))
        return np.asarray((1 / (1 + np.exp(-self.contrast * (value - self.pivot))) - low) / (high - low))

    def apply(self, image: ArrayF64) -> ArrayF64:  # [H, W, 3] sRGB in [0, 1]
        """Apply the look. Return sRGB [H, W, 3] in [0, 1]."""
        image = self.tone(image)
        if not self.sharpening:
            return image
        red, blue = LUMA["bt709"]
        luma = image @ np.array([red, 1 - red - blue, blue])
        detail = luma - cv2.GaussianBlur(luma, (0, 0), SHARPENING_SIGMA)
        return np.asarray(np.clip(image + self.sharpening * detail[..., None], 0, 1), np.float64)


PLAIN = Tone()


def develop(
    image: ArrayF64,  # [H, W, 3] linear light; 1 is sensor white
    *,
    stops: float = 0.0,  # exposure error
    noise: float = 0.0,  # standard deviation at mid grey after the exposure error, sRGB units
    rng: np.random.Generator | None = None,  # None: no noise
    tone: Tone = PLAIN,
) -> ImageU8:  # [H, W, 3]
    """Convert linear light to an 8-bit sRGB image, with exposure error, sensor noise, clipping and look.

    70 % of the variance of the noise is shot noise, which depends on the signal. The rest is read noise.
    """
    image = image * 2.0**stops
    if rng is not None:
        mid_grey_slope = 0.6  # d linear / d sRGB at mid grey: converts ``noise`` to linear light
        shape = np.sqrt(np.clip(image, 0, None) / 0.2 * 0.7 + 0.3)
        image = image + rng.standard_normal(image.shape) * noise * mid_grey_slope * shape
    return np.asarray(np.rint(tone.apply(srgb_from_linear(np.clip(image, 0, 1))) * 255), np.uint8)


def tone_of(seed: int) -> Tone:
    """Return the look of a phone: up to a third more contrast in the middle tones, visible sharpening."""
    rng = np.random.default_rng([seed, Stream.PHONE_LOOK])
    return Tone(rng.uniform(3.0, 4.5), rng.uniform(0.4, 0.5), rng.uniform(0.4, 0.7))


def metered_luminance(light: ArrayF64) -> float:  # [H, W, 3] linear
    """Return the mean luminance over a spot in the middle of the image; it is above 0."""
    red, blue = LUMA["bt709"]
    rows, columns = (
        np.sin(math.pi * (np.arange(size) + 0.5) / size) ** SPOT_POWER for size in light.shape[:2]
    )
    weight = rows[:, None] * columns
    mean = (light @ np.array([red, 1 - red - blue, blue]) * weight).sum() / weight.sum()
    return max(float(mean), 1e-6)


def auto_exposure(
    luminances: ArrayF64,  # [F] from `metered_luminance`
    step: float,  # seconds between frames
) -> ArrayF64:  # [F]
    """Return the gain of each frame in stops, with mean 0. It follows the luminance with `LAG_S`."""
    wanted = -METERING_SHARE * np.log2(luminances)
    gains = wanted.copy()
    for number in range(1, len(wanted)):
        gains[number] = wanted[number] + (gains[number - 1] - wanted[number]) * math.exp(-step / LAG_S)
    return np.asarray(gains - gains.mean(), np.float64)


def encode_and_decode(path: Path, frames: Sequence[ImageU8], fps: float) -> list[ImageU8]:
    """Write ``frames`` [H, W, 3] as the phone's video to ``path``, and return the decoded frames."""
    write_video(path, frames, fps, BITS_PER_PIXEL)
    return [frame for _, frame in decode_frames(path, read_timeline(path).pts)]
