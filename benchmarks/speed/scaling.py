"""Linear fit of cost against size."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np


class Line(NamedTuple):
    """A fit value = offset + slope * number, and the largest relative deviation of a value."""

    offset: float
    slope: float
    deviation: float


def straight_line(points: Sequence[tuple[float, float]]) -> Line:
    """Fit a line to (number, value > 0) by least squares of relative deviations.

    A single point gives a line through the origin.
    """
    numbers, values = np.asarray(points, np.float64).T
    terms = [np.ones_like(numbers), numbers] if len(points) > 1 else [np.zeros_like(numbers), numbers]
    columns = np.stack(terms, 1) / values[:, None]
    offset, slope = np.linalg.lstsq(columns, np.ones_like(values), rcond=None)[0].tolist()
    deviation = np.abs(offset + slope * numbers - values) / values
    return Line(offset, slope, float(deviation.max()))
