"""A no-reference scorer: rivr.primary_scorer=gradient prefers images with steep edges."""

import numpy as np
from numpy.typing import NDArray


class GradientScorer:
    """Created for a device, "cpu" or "cuda"."""

    name, digest = "gradient", "1"

    def __init__(self, device: str) -> None: ...

    def score(self, image: NDArray[np.float32], *, threads: int = 1) -> float:
        """Return a score from 0 to 100 for an sRGB image [H, W, 3] in [0, 1].

        ClearGS lowers the score of images that are flat or clipped.
        """
        down, across = np.gradient(image.astype(np.float64).mean(axis=2))
        return float(100.0 * min(1.0, np.hypot(down, across).mean() / 0.1))
