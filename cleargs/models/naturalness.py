"""A no-reference score from a few image statistics, without a network.

Luminance with its local mean and contrast divided out (MSCN coefficients; Ruderman 1994; Mittal et al.,
BRISQUE, 2012) looks alike in all sharp photographs. Blur makes neighbours agree, over-sharpening and ringing
make them disagree a few pixels on, noise removes the correlation, and each changes the peakedness. A
quadratic in these figures predicts LPIPS to the unseen clean image; its coefficients lie in
``naturalness.toml``.
"""

from __future__ import annotations

import hashlib
import tomllib
from concurrent.futures import ThreadPoolExecutor
from importlib.resources import files

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from cleargs.base_model import FrozenModel
from cleargs.models.tiling import mean_over_tiles
from cleargs.types import ImageF32

COEFFICIENTS = "naturalness.toml"

_TILE = 128  # the side of the patches that the quadratic was fitted on
_SCALES = 2
_WINDOW_SIGMA = 7.0 / 6.0  # as in BRISQUE
_STABILISER = 1.0 / 255.0  # keeps the division finite where there is no contrast
_LIMIT = 4.0  # features beyond so many deviations are cut: a quadratic must not extrapolate
_ERROR = 0.07  # scale of the error of the predicted LPIPS; see ``weights/README.md``
_BT601 = np.array([0.299, 0.587, 0.114], np.float32)


class Quadratic(FrozenModel):
    """``weights . [1, z, z_i z_j (i <= j)]`` of the standardised features z."""

    mean: tuple[float, ...] = Field(description="Mean of each feature over the training patches.")
    deviation: tuple[float, ...] = Field(description="Standard deviation of each feature there.")
    weights: tuple[float, ...] = Field(description="One weight a term.")

    def __call__(self, features: NDArray[np.float64]) -> float:
        """The prediction for features [F]."""
        return float(terms(features, np.array(self.mean), np.array(self.deviation)) @ np.array(self.weights))


class StatisticsScorer:
    """100 - 100 x expected LPIPS, from the statistics of 128-pixel tiles."""

    name = "naturalness-stats"

    def __init__(self) -> None:
        source = (files("cleargs.models") / COEFFICIENTS).read_bytes()
        self.digest = hashlib.sha256(source).hexdigest()
        self._predict = Quadratic.model_validate(tomllib.loads(source.decode("utf-8")))

    def score(self, image: ImageF32, *, threads: int = 1) -> float:
        """Between 0 and 100; the order is that of the predictions. See Scorer."""
        with ThreadPoolExecutor(threads) as pool:
            predicted = mean_over_tiles(
                lambda tiles: pool.map(lambda tile: self._predict(features(tile)), tiles),
                image,
                (_TILE, _TILE),
            )
        return 100.0 * expected(1.0 - predicted)


def expected(estimate: float) -> float:
    """The mean of a figure that lies in [0, 1], whose unbounded estimate has a logistic error.

    E[clip(estimate + error, 0, 1)]: a rising curve between 0 and 1, close to ``estimate`` except near the
    ends. A quadratic knows no bounds and predicts less than no distance for images that are crisper than
    those it was fitted on; a plain cut would call all of them equal.
    """
    below, above = np.logaddexp(0.0, np.array([estimate, estimate - 1.0]) / _ERROR)
    return float(_ERROR * (below - above))


def features(image: ImageF32) -> NDArray[np.float64]:
    """Nine figures at full and at half size. [18]

    image: [H, W, 3] float32 sRGB in [0, 1]. At each size: logarithms of the variance and the kurtosis of the
    MSCN coefficients; their correlation one and two pixels on (the larger and the smaller of the horizontal
    and the vertical one), three pixels on and diagonally (means); the logarithm of the mean local contrast.
    """
    luma = image @ _BT601
    figures: list[float] = []
    for scale in range(_SCALES):
        if scale:
            luma = np.asarray(
                cv2.resize(luma, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA), np.float32
            )
        figures += _scale_features(luma)
    return np.array(figures)


def terms(
    features: NDArray[np.float64],  # [..., F]
    mean: NDArray[np.float64],  # [F]
    deviation: NDArray[np.float64],  # [F]
) -> NDArray[np.float64]:
    """The terms of the quadratic: 1, every standardised feature, every product of two. [..., 1 + F + F (F +
    1) / 2]
    """
    z = np.clip((features - mean) / deviation, -_LIMIT, _LIMIT)
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
