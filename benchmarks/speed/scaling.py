"""Whether cost grows in a straight line."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np


class Line(NamedTuple):
    """value = offset + slope * number, and the largest relative distance of a value from it."""

    offset: float
    slope: float
    deviation: float


def straight_line(points: Sequence[tuple[float, float]]) -> Line:
    """The line through (number, value > 0) that fits best by the squares of relative distances.

    A single point gives the line through the origin.
    """
    numbers, values = np.asarray(points, np.float64).T
    terms = [np.ones_like(numbers), numbers] if len(points) > 1 else [np.zeros_like(numbers), numbers]
    columns = np.stack(terms, 1) / values[:, None]
    offset, slope = np.linalg.lstsq(columns, np.ones_like(values), rcond=None)[0].tolist()
    deviation = np.abs(offset + slope * numbers - values) / values
    return Line(offset, slope, float(deviation.max()))
