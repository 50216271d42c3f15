"""PSNR and SSIM of two 8-bit sRGB images, in float64.

Sums are exact or taken by numpy in a fixed order, so the figures do not depend on the thread count.
"""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

Pixels = NDArray[np.uint8]
Mask = NDArray[np.bool_]

WINDOW = 11
SIGMA = 1.5
_C1, _C2 = 0.01**2, 0.03**2


def psnr(
    image: Pixels,  # [H, W, 3]
    reference: Pixels,  # [H, W, 3]
    mask: Mask | None = None,  # [H, W] True = counts
) -> float | None:
    """Peak signal-to-noise ratio in dB; infinite for equal images, None when no pixel counts."""
    difference = image.astype(np.int64) - reference
    if mask is not None:
        difference = difference[mask]
    if not difference.size:
        return None
    total = int((difference * difference).sum())
    return 10.0 * math.log10(255.0**2 * difference.size / total) if total else math.inf


def ssim(
    image: Pixels,  # [H, W, 3]
    reference: Pixels,  # [H, W, 3]
    mask: Mask | None = None,  # [H, W] True = counts
) -> float | None:
    """Mean structural similarity (Wang et al., 2004) over pixels and channels; 1 for equal images.

    Gaussian window of 11 x 11 pixels and sigma 1.5, data range 1, images mirrored at their border: the
    defaults of torchmetrics, which nerfstudio and gsplat report. (Inria's code pads with zeros, Wang's leaves
    the border out.) Windows that hold a masked pixel do not count. None when no window counts.
    """
    x, y = image / 255.0, reference / 255.0
    mean_x, mean_y = _windowed(x), _windowed(y)
    covariance = _windowed(x * y) - mean_x * mean_y
    variances = _windowed(x * x) - mean_x * mean_x + _windowed(y * y) - mean_y * mean_y
    similarity = (2 * mean_x * mean_y + _C1) * (2 * covariance + _C2)
    similarity /= (mean_x * mean_x + mean_y * mean_y + _C1) * (variances + _C2)
    if mask is not None:
        whole = cv2.erode(mask.astype(np.uint8), np.ones((WINDOW, WINDOW), np.uint8))
        similarity = similarity[whole > 0]
    return float(similarity.mean()) if similarity.size else None


def _windowed(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Gaussian mean of the window around each pixel. [H, W, 3]"""
    kernel = cv2.getGaussianKernel(WINDOW, SIGMA, cv2.CV_64F)
    return np.asarray(cv2.sepFilter2D(values, cv2.CV_64F, kernel, kernel, borderType=cv2.BORDER_REFLECT_101))
