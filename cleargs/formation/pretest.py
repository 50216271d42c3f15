"""Test in a few milliseconds if a frame image has blur that a render does not have, and in which direction.

For a small blur of covariance S the frame image is

    offset + gain * render + shift . grad(render) + tr(S H(render)) / 2

where H is the Hessian of the render. These seven numbers are fitted by least squares on the tiles of one
colour of a checkerboard. The error is measured on the *unseen* tiles of the other colour, and vice versa.
Both images are smoothed first, so that a blur is small compared with the remaining detail. One fit is made
for each size of an image pyramid.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np

from cleargs.splat.kernels.cpu import backend as cpu
from cleargs.types import ArrayF64, PlaneF32

LARGEST = 640
"""Longest side of the largest image that is compared, px: the finest level of a search."""
SIZES = 4
"""Sizes of the pyramid, each half of the one before."""
SMALLEST = 24
"""Shorter side below which a size is left out, px."""
SIGMA = 1.0
"""Standard deviation of the Gaussian that smooths both images at every size, px."""
STRIDE = 2
"""Distance of the rows and columns that are read, px."""
TILE = 32
"""Side of a tile at the largest size, px. A tile covers the same part of the image at smaller sizes."""
MIN_TILE = 4

MIN_VARIANCE = 0.05
"""Variance below which a blur does not count, px^2: that of a sweep of 0.8 px."""

_SHARP, _ALL = 4, 7
"""Number of parameters without a blur, and of all parameters."""
_RIDGE = 1e-9


@dataclass(frozen=True)
class MissingBlur:
    """Blur that a frame image has and a render has not. Lengths are in pixels of the frame image."""

    line_gain: float
    """Share of the squared error on unseen tiles that a blur along one direction removes."""
    line: float
    """Variance of that blur, px^2: L^2 / 12 for a straight sweep of length L. Negative where the render is
    blurrier than the frame image."""
    angle: float
    """Direction of that blur, radians from the x axis towards the y axis."""
    disc_gain: float
    """Share of the error, as for `line_gain`, that a blur with equal variance in all directions removes."""
    disc: float
    """Variance of that second blur along any direction, px^2: R^2 / 4 for a disc of radius R."""

    @property
    def gain(self) -> float:
        """The larger share, among the blurs with a variance above `MIN_VARIANCE`; 0 if there are none."""
        line = self.line_gain if self.line > MIN_VARIANCE else 0.0
        disc = self.disc_gain if self.disc > MIN_VARIANCE else 0.0
        return max(line, disc, 0.0)

    @property
    def length(self) -> float:
        """Length of a straight sweep with the variance `line`, px."""
        return math.sqrt(12.0 * max(self.line, 0.0))


NONE_MISSING = MissingBlur(0.0, 0.0, 0.0, 0.0, 0.0)


def missing_blur(
    render: PlaneF32,  # [H, W] linear luminance
    observed: PlaneF32,  # [H, W] likewise
    weight: PlaneF32,  # [H, W] 0 where a pixel does not count
) -> MissingBlur:
    """Return the missing blur at the size of the pyramid at which a blur explains most."""
    height, width = observed.shape
    scale = min(1.0, LARGEST / max(height, width))
    best = NONE_MISSING
    for k in range(SIZES):
        size = round(0.5**k * scale * width), round(0.5**k * scale * height)
        if (min(size) < SMALLEST and k > 0) or min(size) < 3:
            break
        counted = (_reduced(weight, size, smooth=False) > 0.99).astype(np.float32)
        sums = cpu.blur_sums(
            _reduced(render, size), _reduced(observed, size), counted, STRIDE, max(MIN_TILE, TILE >> k)
        )
        found = _fitted(sums, width / size[0])
        if found.gain > best.gain:
            best = found
    return best


def _reduced(image: PlaneF32, size: tuple[int, int], *, smooth: bool = True) -> PlaneF32:
    if size != image.shape[::-1]:
        image = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA))
    return np.asarray(cv2.GaussianBlur(image, (0, 0), SIGMA), np.float32) if smooth else image


def _fitted(
    sums: ArrayF64,  # [2, 8, 8] products of the regressors over the tiles of each colour
    pixel: float,  # pixels of the frame image per pixel of this size
) -> MissingBlur:
    halves = (sums[0], sums[1]), (sums[1], sums[0])

    def fit(shape: ArrayF64) -> tuple[float, ArrayF64]:
        """Return the squared error on unseen tiles, and the mean of the numbers [7]."""
        numbers = [_solved(fitting, shape) for fitting, _ in halves]
        left = [np.append(x, -1.0) for x in numbers]
        errors = [float(x @ unseen @ x) for (_, unseen), x in zip(halves, left, strict=True)]
        return math.fsum(errors), np.mean(numbers, axis=0)

    sharp = np.eye(_ALL)[:, :_SHARP]
    none = fit(sharp)[0]
    if none <= 0.0:
        return NONE_MISSING
    sxx, sxy, syy = fit(np.eye(_ALL))[1][_SHARP:]
    x, y = np.linalg.eigh([[sxx, sxy], [sxy, syy]])[1][:, 1]
    (line, along), (disc, round_) = (
        fit(np.column_stack([sharp, [0.0, 0.0, 0.0, 0.0, *moments]]))
        for moments in ((x * x, x * y, y * y), (1.0, 0.0, 1.0))
    )
    return MissingBlur(
        1.0 - line / none,
        float(pixel**2 * (along[4] + along[6])),
        math.atan2(y, x),
        1.0 - disc / none,
        float(pixel**2 * round_[4]),
    )


def _solved(sums: ArrayF64, shape: ArrayF64) -> ArrayF64:
    """Return the seven numbers of the best fit among the combinations of the columns of ``shape`` [7, K]."""
    matrix = shape.T @ sums[:_ALL, :_ALL] @ shape
    scale = np.sqrt(np.maximum(matrix.diagonal(), 1e-30))
    matrix = matrix / scale / scale[:, None] + _RIDGE * np.eye(len(matrix))
    solution = np.linalg.solve(matrix, shape.T @ sums[:_ALL, _ALL] / scale)
    return np.asarray(shape @ (solution / scale))
