"""A COLMAP model in another world."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from cleargs.capture.cameras import Pose
from cleargs.capture.model import SparseModel


def moved(
    model: SparseModel,
    *,
    scale: float,
    rotation: NDArray[np.float64],  # [3, 3]
    translation: NDArray[np.float64],  # [3]
) -> SparseModel:
    """``model`` under x -> scale rotation x + translation; every point keeps its place in every image."""

    def pose(before: Pose) -> Pose:
        turned = before.rotation @ rotation.T
        return Pose(turned, -turned @ (scale * rotation @ before.centre + translation))

    return replace(
        model,
        images={key: replace(image, pose=pose(image.pose)) for key, image in model.images.items()},
        xyz=scale * model.xyz @ rotation.T + translation,
    )
