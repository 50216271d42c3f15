"""Read images for the comparisons."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from cleargs.media.image import read_rgb
from cleargs.types import ImageF32


def read_rgb_float(path: Path) -> ImageF32:  # [H, W, 3]
    """Return the image in ``path`` as float32 sRGB in [0, 1]; raise InputError like `read_rgb`."""
    return read_rgb(path).astype(np.float32) / np.float32(255)
