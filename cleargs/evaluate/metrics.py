"""Measures of an image against its reference: PSNR and SSIM in float64, learned metrics, regions, colours.

Images and references are [H, W, 3], masks [H, W] (True counts). Sums are exact or taken by numpy in a fixed
order, so the figures do not depend on the thread count.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import cv2
import numpy as np

from cleargs.evaluate.config import INSTALLABLE, EvalOptions
from cleargs.evaluate.eval_report import Region
from cleargs.media.image import to_float32
from cleargs.models.lpips import load_lpips, weights_file
from cleargs.models.registry import file_digest, model_dir
from cleargs.models.scorer import Scorer, load_scorer
from cleargs.splat.camera import Camera
from cleargs.types import ArrayF64, ImageF32, ImageU8, MaskBool, PlaneF32

WINDOW = 11
SIGMA = 1.5
_C1, _C2 = 0.01**2, 0.03**2

RIDGE = 1e-6
"""Weight that keeps the affine at the identity along the directions of colour that an image does not show."""

FEWEST = 10
"""Minimum number of sparse points that a view must see before its farthest depth is used."""

FARTHEST = 0.99
"""Quantile of the depths of these points. A few points are wrong matches, far behind everything."""

CLIPPED = 254


def psnr(image: ImageU8, reference: ImageU8, mask: MaskBool | None = None) -> float | None:
    """Return the peak signal-to-noise ratio in dB: infinite for equal images, None if no pixel counts."""
    difference = image.astype(np.int64) - reference
    if mask is not None:
        difference = difference[mask]
    if not difference.size:
        return None
    total = int((difference * difference).sum())
    return 10.0 * math.log10(255.0**2 * difference.size / total) if total else math.inf


def ssim(image: ImageU8, reference: ImageU8, mask: MaskBool | None = None) -> float | None:
    """Return the mean structural similarity (Wang et al., 2004) over pixels and channels; 1 for equal images.

    Gaussian window of 11 x 11 pixels and sigma 1.5, data range 1, images mirrored at their border: the
    defaults of torchmetrics, which nerfstudio and gsplat report. (Inria's code pads with zeros, Wang's leaves
    the border out.) Windows with a masked pixel do not count. Returns None if no window counts.
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


def _windowed(values: ArrayF64) -> ArrayF64:
    """Return the Gaussian mean [H, W, 3] of the window around each pixel."""
    kernel = cv2.getGaussianKernel(WINDOW, SIGMA, cv2.CV_64F)
    return np.asarray(cv2.sepFilter2D(values, cv2.CV_64F, kernel, kernel, borderType=cv2.BORDER_REFLECT_101))


@dataclass(frozen=True)
class MetricSet:
    """The loaded metrics of an evaluation. Several threads may use them at the same time."""

    lpips: dict[str, Callable[[ImageF32, ImageF32], float]]
    """Metric -> distance of two float32 sRGB images."""
    scorers: dict[str, Scorer]
    weights: dict[str, str]
    """Metric -> digest of its weights."""
    unavailable: dict[str, str]
    """Metric -> reason why it is unavailable."""

    def measure(self, image: ImageU8, reference: ImageU8, mask: MaskBool | None) -> dict[str, float | None]:
        """Return all metrics of an image; unavailable ones are None.

        For LPIPS, masked pixels are replaced by the reference's. Scorers ignore the mask.
        """
        values = {"psnr": psnr(image, reference, mask), "ssim": ssim(image, reference, mask)}
        seen = image if mask is None else np.where(mask[..., None], image, reference)
        for name, distance in self.lpips.items():
            values[name] = distance(to_float32(seen), to_float32(reference))
        for name, scorer in self.scorers.items():
            values[name] = scorer.score(to_float32(image))
        return values | dict.fromkeys(self.unavailable)


def load_metrics(options: EvalOptions) -> MetricSet:
    """Load the metrics in ``options``. Those whose weights the user has not installed will be null.

    Raises InputError for a scorer with an unknown name or an unusable file.
    """
    found = MetricSet({}, {}, {}, {})
    for net in options.lpips:
        file = model_dir() / weights_file(net)
        if file.is_file():
            found.lpips[f"lpips_{net}"] = load_lpips(net).distance
            found.weights[f"lpips_{net}"] = file_digest(file)
        else:
            found.unavailable[f"lpips_{net}"] = "not installed: run `cleargs models install lpips` once"
    for name in options.scorers:
        if name in INSTALLABLE and not (model_dir() / f"{name}.onnx").is_file():
            found.unavailable[name] = "not installed: see `cleargs models list`"
        else:
            found.scorers[name] = load_scorer(name)
            found.weights[name] = found.scorers[name].digest
    return found


def fit_affine(image: ArrayF64, reference: ArrayF64, mask: MaskBool | None) -> ArrayF64:  # [3, 4]
    """Return the least-squares affine from image to reference, sRGB in [0, 1]; identity without pixels."""
    x = image.reshape(-1, 3) if mask is None else image[mask]
    y = reference.reshape(-1, 3) if mask is None else reference[mask]
    identity = np.eye(3, 4)
    if not len(x):
        return identity
    design = np.column_stack([x, np.ones(len(x))])
    # einsum, not BLAS, whose order of summation depends on its threads.
    normal = np.einsum("ni,nj->ij", design, design) / len(x) + RIDGE * np.eye(4)
    right = np.einsum("ni,nj->ij", design, y) / len(x) + RIDGE * identity.T
    return np.asarray(np.linalg.solve(normal, right).T)


def apply_affine(image: ArrayF64, affine: ArrayF64) -> ArrayF64:
    """Return the image [H, W, 3] mapped by ``affine`` [3, 4] and clipped to [0, 1]."""
    return np.asarray(np.einsum("hwj,ij->hwi", image, affine[:, :3]) + affine[:, 3]).clip(0.0, 1.0)


# -- regions in which scenes with good means may fail: far pixels and clipped pixels ---------------------


def depth_of_points(points: ArrayF64, camera: Camera) -> float | None:
    """Return the depth behind which the view has no sparse points; None if it sees fewer than `FEWEST`.

    ``points`` [P, 3] are in the scene's world.
    """
    x, y, depth = (points @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]).T
    with np.errstate(divide="ignore", invalid="ignore"):
        column, row = camera.fx * x / depth + camera.cx, camera.fy * y / depth + camera.cy
    seen = (depth > 0) & (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
    return float(np.quantile(depth[seen], FARTHEST)) if seen.sum() >= FEWEST else None


def far_pixels(depth: PlaneF32, alpha: PlaneF32, farthest: float) -> MaskBool:
    """Return True for pixels that show something behind ``farthest``, or are more than half transparent.

    ``depth`` is the sum of depths times their blending weights.
    """
    return np.asarray((alpha < 0.5) | (depth > farthest * alpha))


def clipped_pixels(reference: ImageU8) -> MaskBool:
    """Return True for pixels with a channel of at least `CLIPPED`."""
    return np.asarray((reference >= CLIPPED).any(axis=-1))


def region(image: ImageU8, reference: ImageU8, part: MaskBool, mask: MaskBool | None) -> Region:
    """Return share and PSNR of the pixels in ``part`` that ``mask`` lets count."""
    counting = part if mask is None else part & mask
    pixels = part.size if mask is None else int(mask.sum())
    return Region(share=float(counting.sum()) / max(1, pixels), psnr=psnr(image, reference, counting))


def pooled(parts: Iterable[Region | None]) -> Region | None:
    """Return the region over all images. Each image counts equally, independent of its size."""
    found = [part for part in parts if part is not None]
    if not found:
        return None
    share = math.fsum(part.share for part in found)
    error = math.fsum(part.share * 10 ** (-part.psnr / 10) for part in found if part.psnr is not None)
    level = None if not share else -10 * math.log10(error / share) if error else math.inf
    return Region(share=share / len(found), psnr=level)
