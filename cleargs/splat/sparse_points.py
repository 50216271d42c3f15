"""Sparse points of a capture, as a training starts from them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class SparsePoints:
    """Sparse points, and the training views that observe them."""

    xyz: NDArray[np.float64]  # [P, 3] normalised world
    rgb: NDArray[np.uint8]  # [P, 3] sRGB
    observed: list[NDArray[np.int64]]
    """Rows of ``xyz`` that each view observes."""
