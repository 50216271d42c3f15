"""A frame's formation in numbers: how the camera moved and focused while the frame was taken."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal, TypeAlias

import numpy as np

from cleargs.splat.camera import Camera
from cleargs.types import ArrayF32, ArrayF64

TWIST = 6
"""Numbers of a twist: translation by x, y, z, then rotation about them, in camera axes."""

Model: TypeAlias = Literal["none", "blur", "skew", "both", "defocus"]
"""What a frame is explained by; ``both`` is blur and skew."""

MODELS: tuple[Model, ...] = ("none", "blur", "skew", "both", "defocus")


def _still() -> ArrayF64:
    return np.zeros(TWIST)


@dataclass(frozen=True, eq=False)
class FrameMotion:
    """What happened while a frame was taken.

    Twists [6] say how the scene moved past the camera, in camera axes; the camera moved the other way.
    They are in pixels: a rotation by angle a is fx * a, a translation by d is fx * d / median depth.
    """

    blur: ArrayF64 = field(default_factory=_still)
    """From the start to the end of a row's exposure."""
    skew: ArrayF64 = field(default_factory=_still)
    """From the first to the last row's exposure: the rolling shutter. The middle row has the frame's pose."""
    pose: ArrayF64 = field(default_factory=_still)
    """From the frame's pose as given to that at the middle of its exposure."""
    disc_px: float = 0.0
    """Radius of the disc of defocus, pixels per unit of nearness beyond the focus."""
    focus: float = 1.0
    """Nearness in focus: the median depth over the depth in focus."""
    median_depth: float = 1.0

    @property
    def vector(self) -> ArrayF64:
        """Pose, blur and skew, [18]."""
        return np.concatenate([self.pose, self.blur, self.skew])

    def with_vector(self, vector: ArrayF64) -> FrameMotion:
        """This motion with another pose, blur and skew [18]."""
        pose, blur, skew = vector.reshape(3, TWIST)
        return replace(self, pose=pose, blur=blur, skew=skew)


def widened(camera: Camera, margin: int) -> Camera:
    """The camera with ``margin`` more pixels on every side."""
    if margin == 0:
        return camera
    return replace(
        camera,
        width=camera.width + 2 * margin,
        height=camera.height + 2 * margin,
        cx=camera.cx + margin,
        cy=camera.cy + margin,
    )


def flow_basis(
    camera: Camera,
    nearness: ArrayF32,  # [H, W] median depth over depth
) -> ArrayF32:
    """Where a pixel looks in the still image under each component of a twist of the scene past the camera:
    [6, 2, H, W] pixels per unit. It is the flow that the same motion of the camera gives.

    The camera may be larger than ``nearness``, in proportion.
    Source: Longuet-Higgins & Prazdny, "The interpretation of a moving retinal image" (1980).
    """
    height, width = nearness.shape
    column = (np.arange(width) + 0.5) * camera.width / width
    row = (np.arange(height) + 0.5) * camera.height / height
    x, y = np.meshgrid((column - camera.cx) / camera.fx, (row - camera.cy) / camera.fy)
    none = np.zeros_like(x)
    along_x = np.stack([-nearness, none, x * nearness, x * y, -(1 + x * x), y])
    along_y = np.stack([none, -nearness, y * nearness, 1 + y * y, -x * y, -x]) * (camera.fy / camera.fx)
    scales = width / camera.width, height / camera.height
    return np.stack([scales[0] * along_x, scales[1] * along_y], axis=1).astype(np.float32)
