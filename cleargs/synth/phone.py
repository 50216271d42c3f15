"""What a phone makes of a frame: its tone curve, its sharpening, its automatic exposure, its video codec.

The look (tone curve and sharpening) is the camera's, not a fault: the truth of a capture has it too. What the
exposure and the codec add is in the frames alone.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from cleargs.media.colour import LUMA
from cleargs.media.encode import write_video
from cleargs.media.video import decode_frames, read_timeline
from cleargs.random_streams import Stream
from cleargs.types import ArrayF64, ImageU8

NOISE = 1.5 / 255
"""Deviation of the sensor noise at mid grey, sRGB units: a phone's small pixels, indoors."""
BITS_PER_PIXEL = 0.6
"""Rate of the video, held over a second. The decoded frames lie some 35 dB from the uncoded ones: visible,
as in a phone's video, which has 0.3 bits at 1080p but whose frames are larger and closer in time."""
SHARPENING_SIGMA = 1.0
"""Deviation of the Gaussian that separates the detail to sharpen, pixels of the image."""
SPOT = 8
"""Power of the sine that weights the metered picture: most weight lies in the middle third of each side."""
LAG = 0.6
"""Seconds in which automatic exposure covers all but 1 / e of a change."""
METERED = 0.8
"""Share of a change of brightness, in stops, that automatic exposure makes up for in the end."""


@dataclass(frozen=True)
class Look:
    """How a camera renders light: an S-shaped tone curve, then an unsharp mask on luma, on sRGB values."""

    contrast: float = 0.0
    """Steepness of the logistic curve; 0: none."""
    pivot: float = 0.5
    """Where the curve is steepest, sRGB in [0, 1]: contrast rises there and falls towards black and white."""
    sharpening: float = 0.0
    """Share of the luma's fine detail that is added to all channels."""

    def tone(self, value: ArrayF64) -> ArrayF64:
        """The curve: [0, 1] onto [0, 1], rising."""
        if not self.contrast:
            return value
        low, high = (1 / (1 + math.exp(-self.contrast * (end - self.pivot))) for end in (0.0, 1.0))
        return np.asarray((1 / (1 + np.exp(-self.contrast * (value - self.pivot))) - low) / (high - low))

    def apply(self, image: ArrayF64) -> ArrayF64:  # [H, W, 3] sRGB in [0, 1]
        """sRGB in [0, 1]."""
        image = self.tone(image)
        if not self.sharpening:
            return image
        red, blue = LUMA["bt709"]
        luma = image @ np.array([red, 1 - red - blue, blue])
        detail = luma - cv2.GaussianBlur(luma, (0, 0), SHARPENING_SIGMA)
        return np.asarray(np.clip(image + self.sharpening * detail[..., None], 0, 1), np.float64)


PLAIN = Look()


def phone_look(seed: int) -> Look:
    """The look of a phone: contrast up to a third higher in the middle tones, visible sharpening."""
    rng = np.random.default_rng([seed, Stream.PHONE_LOOK])
    return Look(rng.uniform(3.0, 4.5), rng.uniform(0.4, 0.5), rng.uniform(0.4, 0.7))


def metered(light: ArrayF64) -> float:  # [H, W, 3] linear
    """What the meter sees: the mean luminance, above 0, over a spot in the middle."""
    red, blue = LUMA["bt709"]
    rows, columns = (np.sin(math.pi * (np.arange(size) + 0.5) / size) ** SPOT for size in light.shape[:2])
    weight = rows[:, None] * columns
    mean = (light @ np.array([red, 1 - red - blue, blue]) * weight).sum() / weight.sum()
    return max(float(mean), 1e-6)


def auto_exposure(
    luminances: ArrayF64, step: float
) -> ArrayF64:  # [F] of `metered`, seconds from frame to frame
    """The gain of each frame in stops [F], of mean 0: it goes towards what the frame asks for, with `LAG`."""
    wanted = -METERED * np.log2(luminances)
    gains = wanted.copy()
    for number in range(1, len(wanted)):
        gains[number] = wanted[number] + (gains[number - 1] - wanted[number]) * math.exp(-step / LAG)
    return np.asarray(gains - gains.mean(), np.float64)


def coded(path: Path, frames: Sequence[ImageU8], fps: float) -> list[ImageU8]:
    """Write ``frames`` [H, W, 3] as the phone's video to ``path``, and give back what a player shows."""
    write_video(path, frames, fps, BITS_PER_PIXEL)
    return [frame for _, frame in decode_frames(path, read_timeline(path).pts)]
