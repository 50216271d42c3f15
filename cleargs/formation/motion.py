"""Parameters of a frame's image formation: motion and focus of the camera while it took the frame."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal, TypeAlias

import numpy as np

from cleargs.splat.camera import Camera, Readout
from cleargs.types import ArrayF32, ArrayF64

TWIST = 6
"""Number of values of a twist: translation along x, y, z, then rotation about x, y, z, in camera axes."""

TWISTS = ("pose", "blur", "skew", "bend", "cube", "skew_bend")
"""Names of a motion's twists, in the order of its numbers."""

POSE, BLUR, SKEW, BEND, CUBE, _ = (slice(k * TWIST, (k + 1) * TWIST) for k in range(len(TWISTS)))
"""Places of the twists in `FrameMotion.vector`."""

Model: TypeAlias = Literal["none", "blur", "skew", "both", "defocus"]
"""Model that explains a frame; ``both`` is blur and skew."""

MODELS: tuple[Model, ...] = ("none", "blur", "skew", "both", "defocus")


def _zeros() -> ArrayF64:
    return np.zeros(TWIST)


@dataclass(frozen=True, eq=False)
class FrameMotion:
    """Motion and focus of the camera while it took a frame.

    Twists [6] give the motion of the scene past the camera, in camera axes; the camera moved the other way.
    They are in pixels: a rotation by angle a is fx * a, a translation by d is fx * d / median depth.

    At time t of a row's exposure, from -1/2 to 1/2, the scene has moved by
    pose + t blur + (t^2 - 1/12) bend + (t^3 - 3t/20) cube. The polynomials are orthogonal, so that a
    higher order does not change the mean pose and the lower orders.
    """

    blur: ArrayF64 = field(default_factory=_zeros)
    """Motion from the start to the end of a row's exposure: the part of the path that is linear in time."""
    skew: ArrayF64 = field(default_factory=_zeros)
    """Motion from the first to the last row's exposure (rolling shutter); 0 at the middle row."""
    skew_bend: ArrayF64 = field(default_factory=_zeros)
    """Second order of a measured skew: times s^2 at s of the readout, -1/2 to 1/2."""
    columns: bool = False
    """True if the columns are read one after the other: ``skew`` is from the first to the last column."""
    pose: ArrayF64 = field(default_factory=_zeros)
    """Motion from the given pose of the frame to the mean pose of its exposure."""
    bend: ArrayF64 = field(default_factory=_zeros)
    cube: ArrayF64 = field(default_factory=_zeros)
    disc_px: float = 0.0
    """Radius of the disc of defocus, pixels per unit of nearness beyond the focus."""
    focus: float = 1.0
    """Nearness in focus: the median depth over the depth in focus."""
    median_depth: float = 1.0
    exposure_s: float = 0.0
    """Exposure time, s, if the blur is the measured motion during it; 0: none, or a searched blur."""

    @property
    def vector(self) -> ArrayF64:
        """The twists in the order of `TWISTS`, [36]."""
        return np.concatenate([getattr(self, name) for name in TWISTS])

    def with_vector(self, vector: ArrayF64) -> FrameMotion:
        """Return this motion with the twists in ``vector`` [36], in the order of `vector`."""
        pose, blur, skew, bend, cube, skew_bend = vector.reshape(len(TWISTS), TWIST)
        return replace(self, pose=pose, blur=blur, skew=skew, bend=bend, cube=cube, skew_bend=skew_bend)

    def exposed_only(self) -> FrameMotion | None:
        """Return the motion during the exposure and the defocus, without pose and skew, if there are any."""
        if not (self.blur.any() or self.bend.any() or self.cube.any() or self.disc_px > 0.0):
            return None
        return replace(self, pose=_zeros(), skew=_zeros(), skew_bend=_zeros())

    @property
    def order(self) -> int:
        """Order of the path in time: 1 straight (or none), 2 quadratic, 3 cubic."""
        return 3 if self.cube.any() else 2 if self.bend.any() else 1


def readout_of(motion: FrameMotion, camera: Camera, factor: float = 1.0) -> Readout:
    """Return the pose and the skew of ``motion`` as the rolling shutter of the frame's ``camera``.

    ``motion`` is in pixels of a frame that is 1 / ``factor`` times as large.
    """
    pixels = factor / camera.fx * np.array([motion.median_depth] * 3 + [1.0] * 3)
    twists = pixels * np.stack([motion.pose, motion.skew, motion.skew_bend])
    if motion.columns:
        return Readout(twists, camera.fx / camera.width, camera.cx / camera.width - 0.5, True)
    return Readout(twists, camera.fy / camera.height, camera.cy / camera.height - 0.5)


def widened(camera: Camera, margin: int) -> Camera:
    """Return the camera with ``margin`` more pixels on every side."""
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
    """Return the displacement of every pixel under each component of a twist, [6, 2, H, W] pixels per unit.

    The twist is the motion of the scene past the camera. A displacement points from a pixel to the place in
    the sharp image that it shows. It equals the optical flow of the same motion of the camera. Pixels are
    those of ``nearness``. The image of ``camera`` may be larger, in proportion.
    Source: Longuet-Higgins & Prazdny, "The interpretation of a moving retinal image" (1980).
    """
    height, width = nearness.shape
    column = (np.arange(width) + 0.5) * camera.width / width
    row = (np.arange(height) + 0.5) * camera.height / height
    x, y = np.meshgrid((column - camera.cx) / camera.fx, (row - camera.cy) / camera.fy)
    along_x = -nearness, None, x * nearness, x * y, -(1 + x * x), y
    along_y = None, -nearness, y * nearness, 1 + y * y, -x * y, -x
    scales = width / camera.width, height / camera.height * (camera.fy / camera.fx)
    basis = np.zeros((TWIST, 2, height, width), np.float32)
    for k, components in enumerate(zip(along_x, along_y, strict=True)):
        for axis, component in enumerate(components):
            if component is not None:
                basis[k, axis] = scales[axis] * component
    return basis


def grid_basis(camera: Camera, shape: tuple[int, int]) -> ArrayF64:
    """Return `flow_basis` at the median depth and the centres of a grid, [6, 2, rows, columns] camera px."""
    basis = flow_basis(camera, np.ones(shape, np.float32)).astype(np.float64)
    basis *= np.array([camera.width / shape[1], camera.height / shape[0]])[:, None, None]
    return basis


def pixel_paths(
    motion: FrameMotion, camera: Camera, shape: tuple[int, int], times: ArrayF64
) -> ArrayF64:  # [T, rows, columns, 2] px
    """Return the displacements of the pixels at the centres of a grid at ``times`` of the exposure.

    They are those at the median depth, relative to the mean over the exposure. ``shape`` is the numbers of
    rows and columns of the grid. Times are from -1/2 to 1/2.
    """
    basis = grid_basis(camera, shape)
    orders = np.stack([times, times**2 - 1 / 12, times**3 - 3 * times / 20])
    twists = np.stack([motion.blur, motion.bend, motion.cube])
    return np.asarray(np.einsum("ot,on,ncij->tijc", orders, twists, basis))
