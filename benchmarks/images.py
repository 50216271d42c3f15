"""Read images for the comparisons."""

from __future__ import annotations

from pathlib import Path

from cleargs.media.image import read_rgb, to_float32
from cleargs.types import ImageF32


def read_rgb_float(path: Path) -> ImageF32:  # [H, W, 3]
    """Return the image in ``path`` as float32 sRGB in [0, 1]; raise InputError like `read_rgb`."""
    return to_float32(read_rgb(path))
