"""A no-reference scorer: rivr.primary_scorer=gradient finds images with steep edges good."""

import numpy as np
from numpy.typing import NDArray


class GradientScorer:
    """Made for a device, "cpu" or "cuda"."""

    name, digest = "gradient", "1"

    def __init__(self, device: str) -> None: ...

    def score(self, image: NDArray[np.float32], *, threads: int = 1) -> float:
        """0 to 100, of an image [H, W, 3] sRGB in [0, 1]; lowered by ClearGS where it is flat or clipped."""
        down, across = np.gradient(image.astype(np.float64).mean(axis=2))
        return float(100.0 * min(1.0, np.hypot(down, across).mean() / 0.1))
