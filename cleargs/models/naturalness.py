"""A no-reference score from a few image statistics, without a network.

Luminance that is normalised by its local mean and contrast (MSCN coefficients; Ruderman 1994; Mittal et al.,
BRISQUE, 2012) has similar statistics in all sharp photographs. Blur, ringing and noise change the correlation
of neighbours and the kurtosis. A quadratic function of these statistics, with the coefficients in
``naturalness.toml``, predicts LPIPS to the unknown clean image.
"""

from __future__ import annotations

import hashlib
import tomllib
from concurrent.futures import ThreadPoolExecutor
from importlib.resources import files

import cv2
import numpy as np
from pydantic import Field

from cleargs.base_model import FrozenModel
from cleargs.models.tiling import mean_over_tiles
from cleargs.types import ArrayF64, ImageF32

COEFFICIENTS = "naturalness.toml"

_TILE = 128  # px; side of the patches to which the quadratic was fitted
_WINDOW_SIGMA = 7.0 / 6.0  # px, as in BRISQUE
_STABILISER = 1.0 / 255.0  # keeps the division finite in areas without contrast
_MAX_DEVIATIONS = 4.0  # features are clipped at these deviations: a quadratic must not extrapolate
_ERROR_SCALE = 0.07  # logistic scale of the error of the predicted LPIPS; see ``weights/README.md``
_BT601 = np.array([0.299, 0.587, 0.114], np.float32)


class Quadratic(FrozenModel):
    """Quadratic function ``weights . [1, z, z_i z_j (i <= j)]`` of the standardised features z."""

    mean: tuple[float, ...] = Field(description="Mean of each feature over the training patches.")
    deviation: tuple[float, ...] = Field(description="Standard deviation of each feature over the patches.")
    weights: tuple[float, ...] = Field(description="Weight of each term.")

    def __call__(self, features: ArrayF64) -> float:
        """Return the prediction for features [F]."""
        return float(terms(features, np.array(self.mean), np.array(self.deviation)) @ np.array(self.weights))


class StatisticsScorer:
    """Scorer that predicts 100 - 100 x LPIPS from the statistics of tiles of 128 pixels."""

    name = "naturalness-stats"

    def __init__(self) -> None:
        source = (files("cleargs.models") / COEFFICIENTS).read_bytes()
        self.digest = hashlib.sha256(source).hexdigest()
        self._predict = Quadratic.model_validate(tomllib.loads(source.decode("utf-8")))

    def score(self, image: ImageF32, *, threads: int = 1) -> float:
        """Return a score between 0 and 100, as `cleargs.models.scorer.Scorer.score`."""
        with ThreadPoolExecutor(threads) as pool:
            predicted = mean_over_tiles(
                lambda tiles: pool.map(lambda tile: self._predict(features(tile)), tiles),
                image,
                (_TILE, _TILE),
            )
        return 100.0 * expected_value(1.0 - predicted)


def expected_value(estimate: float) -> float:
    """Return E[clip(estimate + error, 0, 1)] for a logistic error, a strictly rising curve between 0 and 1.

    The quadratic is unbounded: for images crisper than its training patches it predicts a negative LPIPS. A
    clipped prediction would give all of these images the same score.
    """
    below, above = np.logaddexp(0.0, np.array([estimate, estimate - 1.0]) / _ERROR_SCALE)
    return float(_ERROR_SCALE * (below - above))


def features(image: ImageF32) -> ArrayF64:  # [H, W, 3] sRGB in [0, 1]
    """Return nine statistics at full size and nine at half size, [18].

    At each size: logarithms of the variance and the kurtosis of the MSCN coefficients; their correlations at
    a distance of one and two pixels (the larger and the smaller of horizontal and vertical), at three pixels
    (mean), and along the diagonals (mean); and the logarithm of the mean local contrast.
    """
    luma = image @ _BT601
    half = cv2.resize(luma, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    return np.array([*_scale_features(luma), *_scale_features(np.asarray(half, np.float32))])


def terms(
    features: ArrayF64,  # [..., F]
    mean: ArrayF64,  # [F]
    deviation: ArrayF64,  # [F]
) -> ArrayF64:
    """Return the terms of the quadratic, [..., 1 + F + F (F + 1) / 2]: 1, features, products of two."""
    z = np.clip((features - mean) / deviation, -_MAX_DEVIATIONS, _MAX_DEVIATIONS)
    i, j = np.triu_indices(z.shape[-1])
    return np.concatenate([np.ones_like(z[..., :1]), z, z[..., i] * z[..., j]], axis=-1)


def _scale_features(luma: ImageF32) -> list[float]:
    mean = _blur(luma)
    contrast = np.sqrt(np.maximum(_blur(luma * luma) - mean * mean, 0.0))
    mscn = ((luma - mean) / (contrast + _STABILISER)).astype(np.float64)
    variance = float((mscn * mscn).mean()) + 1e-9

    def correlation(dy: int, dx: int) -> float:
        height, width = mscn.shape
        here = mscn[: height - dy, max(0, -dx) : width - max(0, dx)]
        there = mscn[dy:, max(0, dx) : width + min(0, dx)]
        return float((here * there).mean()) / variance

    one, two, three = ((correlation(0, lag), correlation(lag, 0)) for lag in (1, 2, 3))
    kurtosis = float((mscn**4).mean()) / variance**2
    return [
        np.log(variance),
        np.log(kurtosis + 1e-2),
        max(one),
        min(one),
        max(two),
        min(two),
        sum(three) / 2.0,
        (correlation(1, 1) + correlation(1, -1)) / 2.0,
        np.log(float(contrast.mean(dtype=np.float64)) + 1e-3),
    ]


def _blur(image: ImageF32) -> ImageF32:
    return np.asarray(cv2.GaussianBlur(image, (0, 0), _WINDOW_SIGMA), np.float32)
