"""Colour alignment: the affine on sRGB that takes an image nearest to its reference."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cleargs.evaluate.metrics import Mask

_RIDGE = 1e-6  # holds the directions of colour that an image does not show at the identity


def fit_affine(
    image: NDArray[np.float64],  # [H, W, 3] sRGB in [0, 1]
    reference: NDArray[np.float64],  # [H, W, 3]
    mask: Mask | None,  # [H, W] True = counts
) -> NDArray[np.float64]:  # [3, 4]
    """Matrix and offset of least squares over the pixels that count; the identity when none does."""
    x = image.reshape(-1, 3) if mask is None else image[mask]
    y = reference.reshape(-1, 3) if mask is None else reference[mask]
    identity = np.eye(3, 4)
    if not len(x):
        return identity
    design = np.column_stack([x, np.ones(len(x))])
    # einsum, not BLAS, whose order of summation depends on its threads.
    normal = np.einsum("ni,nj->ij", design, design) / len(x) + _RIDGE * np.eye(4)
    right = np.einsum("ni,nj->ij", design, y) / len(x) + _RIDGE * identity.T
    affine: NDArray[np.float64] = np.linalg.solve(normal, right).T
    return affine


def apply_affine(image: NDArray[np.float64], affine: NDArray[np.float64]) -> NDArray[np.float64]:
    """The image [H, W, 3] through ``affine`` [3, 4], clipped to [0, 1]."""
    mapped: NDArray[np.float64] = np.einsum("hwj,ij->hwi", image, affine[:, :3]) + affine[:, 3]
    return mapped.clip(0.0, 1.0)
