"""The image that the statistics look at: luminance at a bounded size, and which of its pixels count."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from cleargs.errors import StoreError
from cleargs.rva.evaluator import View

Plane = npt.NDArray[np.float32]
Mask = npt.NDArray[np.bool_]

LONG_SIDE = 640
"""Images are reduced (never enlarged) to this long side: blur is measured in pixels of that size."""


@dataclass(frozen=True)
class Luminance:
    """Rec.601 luma of an sRGB image, 0 to 255."""

    full: Plane  # [H, W] as given
    reduced: Plane  # [h, w] long side at most LONG_SIDE
    valid: Mask  # [h, w] not masked


def reduce_luminance(
    rgb: npt.NDArray[np.uint8],  # [H, W, 3] sRGB
    mask: npt.NDArray[np.uint8] | None,  # [H, W], 0 = ignore
) -> Luminance:
    """Luma as given, and reduced by area averaging; a reduced pixel counts if all that it averages does."""
    full = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY).astype(np.float32)
    height, width = full.shape
    scale = LONG_SIDE / max(height, width)
    size = (max(1, round(width * scale)), max(1, round(height * scale))) if scale < 1.0 else (width, height)
    reduced = _shrink(full, size)
    if mask is None:
        return Luminance(full, reduced, np.ones(reduced.shape, dtype=bool))
    kept = _shrink((mask > 0).astype(np.float32), size)
    return Luminance(full, reduced, kept > 0.999)


def _shrink(plane: Plane, size: tuple[int, int]) -> Plane:  # size: (width, height)
    return np.asarray(cv2.resize(plane, size, interpolation=cv2.INTER_AREA), dtype=np.float32)


def load_luminance(view: View) -> Luminance:
    """Read a frame and its mask from disk. Raises StoreError when one cannot be read."""
    rgb = _read(view.image, cv2.IMREAD_COLOR_RGB)
    mask = _read(view.mask, cv2.IMREAD_GRAYSCALE) if view.mask else None
    if mask is not None and mask.shape != rgb.shape[:2]:
        raise StoreError(
            f"the mask {view.mask} differs in size from its image", hint="run again with --force ingest"
        )
    return reduce_luminance(rgb, mask)


def _read(path: Path, flags: int) -> npt.NDArray[np.uint8]:
    image = cv2.imread(str(path), flags)
    if image is None:
        raise StoreError(f"cannot read {path} as an image", hint="run again with --force ingest")
    return np.asarray(image, dtype=np.uint8)


def away_from_masked(valid: Mask, radius: int) -> Mask:
    """Valid pixels at least ``radius`` (pixels, square neighbourhood) from masked ones and the border."""
    kernel = np.ones((2 * radius + 1, 2 * radius + 1), dtype=np.uint8)
    eroded = cv2.erode(valid.astype(np.uint8), kernel, borderType=cv2.BORDER_CONSTANT, borderValue=0)
    return np.asarray(eroded > 0)
