"""A frame's motion: two twists of the camera, and the ways of the pixels that follow from them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cleargs.splat.camera import Camera

Floats = NDArray[np.float32]
Vector = NDArray[np.float64]

TWIST = 6
"""Numbers of a twist: translation by x, y, z, then rotation about them, in camera axes."""


@dataclass(frozen=True, eq=False)
class Motion:
    """How the camera moved while a frame was taken.

    Twists [6] are in pixels: a rotation by angle a is fx * a, a translation by d is fx * d / median depth.
    """

    blur: Vector
    """From the start to the end of a row's exposure."""
    skew: Vector
    """From the first to the last row's exposure: the rolling shutter. The middle row has the frame's pose."""

    def ways(self, basis: Floats) -> tuple[Floats, Floats]:
        """Where a frame's pixels look during their exposure: offset and sweep [2, H, W] of `kernels`."""
        height = basis.shape[2]
        down = ((np.arange(height, dtype=np.float32) + 0.5) / height - 0.5)[:, None]
        offset = np.tensordot(self.skew.astype(np.float32), basis, 1) * down
        return offset, np.tensordot(self.blur.astype(np.float32), basis, 1)


def instants(count: int) -> Floats:
    """The middles of ``count`` equal parts of an exposure from -1/2 to 1/2."""
    return ((np.arange(count, dtype=np.float32) + 0.5) / count - 0.5).astype(np.float32)


def flow_basis(camera: Camera, depth: Floats) -> Floats:
    """The image's flow under each component of a twist: [6, 2, H, W] pixels per unit.

    depth: [H, W], the distance along the optical axis; the camera may be larger than it, in proportion.
    Source: Longuet-Higgins & Prazdny, "The interpretation of a moving retinal image" (1980).
    """
    height, width = depth.shape
    column = (np.arange(width) + 0.5) * camera.width / width
    row = (np.arange(height) + 0.5) * camera.height / height
    x, y = np.meshgrid((column - camera.cx) / camera.fx, (row - camera.cy) / camera.fy)
    near, none = np.median(depth) / depth, np.zeros_like(x)
    along_x = np.stack([-near, none, x * near, x * y, -(1 + x * x), y])
    along_y = np.stack([none, -near, y * near, 1 + y * y, -x * y, -x]) * (camera.fy / camera.fx)
    scales = width / camera.width, height / camera.height
    return np.stack([scales[0] * along_x, scales[1] * along_y], axis=1).astype(np.float32)
