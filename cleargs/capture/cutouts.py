"""Cut-outs: pictures whose transparent parts are empty space, as in NeRF-synthetic, not pixels to ignore."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import numpy as np

from cleargs.files import write_bytes
from cleargs.media.image import read_transparency
from cleargs.types import ImageU8, MaskU8

_SAME = 0.001  # largest share of the pixels in which two equal transparencies differ


def are_cut_outs(pictures: Sequence[Path]) -> bool:
    """Return True if all ``pictures`` are transparent in places, and not all in the same places.

    If only some are, parts of these were removed. If all are in the same places, it is a border.
    """
    first: MaskU8 | None = None
    differ = False
    for path in pictures:
        alpha = read_transparency(path)
        if alpha is None:
            return False
        if first is None:
            first = alpha
        elif not differ:
            apart = alpha.shape != first.shape or ((alpha > 127) != (first > 127)).mean() > _SAME
            differ = bool(apart)
    return differ


def resampled(
    rgb: ImageU8,  # [H, W, 3]
    alpha: MaskU8,  # [H, W]
    resample: Callable[[ImageU8], ImageU8],
) -> tuple[ImageU8, MaskU8]:
    """Return a picture and its alpha after ``resample``; transparent pixels give no colour to others."""
    levels = resample(np.repeat(alpha[..., None], 3, axis=2))[..., :1].astype(np.float32)
    shaded = resample(np.rint(rgb * (alpha[..., None] / np.float32(255))).astype(np.uint8))
    colours = np.where(levels > 0, shaded * np.float32(255) / np.maximum(levels, 1), 0)
    return np.rint(np.minimum(colours, 255)).astype(np.uint8), levels[..., 0].astype(np.uint8)


def over_white(rgb: ImageU8, alpha: MaskU8) -> ImageU8:  # [H, W, 3], [H, W]
    """Return a picture over white, blended in sRGB."""
    share = alpha[..., None] / np.float32(255)
    return np.asarray(np.rint(rgb * share + 255 * (1 - share)), np.uint8)


def write_cut_out(path: Path, rgb: ImageU8, alpha: MaskU8) -> None:
    """Write a PNG of four channels atomically. Raises StoreError like `cleargs.media.image.write_rgb`."""
    picture = np.dstack([rgb[..., ::-1], alpha])
    write_bytes(path, cv2.imencode(".png", np.ascontiguousarray(picture))[1].tobytes())
