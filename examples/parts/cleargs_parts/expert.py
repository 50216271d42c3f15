"""A restoration expert: rivr.expert=unsharp sharpens by unsharp masking."""

import cv2
import numpy as np
from numpy.typing import NDArray


class UnsharpMask:
    """Created for a device, "cpu" or "cuda"."""

    name, digest = "unsharp", "1"

    def __init__(self, device: str) -> None: ...

    def restore(
        self,
        image: NDArray[np.float32],  # [H, W, 3] sRGB in [0, 1], like the result
        *,
        threads: int = 1,
    ) -> NDArray[np.float32]:
        soft = cv2.GaussianBlur(image, (0, 0), 1.5)
        return np.clip(image + (image - soft), 0.0, 1.0)
