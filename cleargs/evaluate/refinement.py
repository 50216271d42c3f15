"""Refinement of the pose of a render, so that the render explains a reference image best.

Levenberg-Marquardt on the photometric difference, first at a reduced size, then at full size. The kernels
give no gradient of the camera, so the six columns of the Jacobian are central differences.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from cleargs.evaluate.eval_report import Refinement
from cleargs.splat.camera import Camera
from cleargs.types import ArrayF64, ImageU8, MaskBool

Render = Callable[[Camera], ArrayF64]
"""A function that returns the render at a camera, [H, W, 3] sRGB in [0, 1]."""

LONG_SIDE = 320
"""Long side of the reduced images, px. At this size, steps reach farther."""

_BLUR = 1.0  # px of the reduced image; widens the reach of a step to a few pixels
_DIFFERENCE = 0.25  # px that a probing movement shifts the image
_FINE = 0.5  # share of the steps at full size


def refine_pose(
    render: Render,
    camera: Camera,
    distance: float,
    reference: ImageU8,  # [H, W, 3]
    mask: MaskBool | None,  # [H, W] True = counts
    steps: int,
) -> tuple[Camera, Refinement]:
    """Return ``camera`` with the pose that lowers the mean squared difference, after ``steps`` steps.

    Half of the steps are at full size. A pose is accepted only if the difference at full size falls: a pose
    that fits reduced, blurred images better may be worse at full size.

    ``distance`` is a typical distance of the scene. It makes a unit of movement shift the image as much as a
    unit of rotation does.
    """
    fine = max(1, round(_FINE * steps))
    small = camera.scaled(min(1.0, LONG_SIDE / max(camera.width, camera.height)))
    reduced = _Comparison(render, small, reference, mask, blur=_BLUR)
    coarse = _descend(reduced, small, distance, steps - fine)
    whole = _Comparison(render, camera, reference, mask, blur=0.0)
    first = whole.loss(camera)
    best = min((camera, replace(camera, world_to_camera=coarse.world_to_camera)), key=whole.loss)
    refined = _descend(whole, best, distance, fine)
    return refined, Refinement(
        rotation_deg=rotation_between(camera.world_to_camera[:3, :3], refined.world_to_camera[:3, :3]),
        shift=float(np.linalg.norm(refined.centre - camera.centre)),
        loss_before=first,
        loss_after=whole.loss(refined),
    )


class _Comparison:
    """Differences of renders from one reference, at the size of ``camera``."""

    def __init__(
        self, render: Render, camera: Camera, reference: ImageU8, mask: MaskBool | None, *, blur: float
    ) -> None:
        size = (camera.width, camera.height)
        self._render = render
        self._blur = blur
        self._target = np.asarray(cv2.resize(reference / 255.0, size, interpolation=cv2.INTER_AREA))
        self._counts = np.ones(self._target.shape[:2])
        if mask is not None:  # a reduced pixel counts if every pixel under it does
            covered = cv2.resize(mask.astype(np.float64), size, interpolation=cv2.INTER_AREA)
            self._counts = (np.asarray(covered) > 0.999).astype(np.float64)

    def difference(self, pose: Camera) -> ArrayF64:
        masked = (self._render(pose) - self._target) * self._counts[..., None]
        if self._blur > 0:
            masked = np.asarray(cv2.GaussianBlur(masked, (0, 0), self._blur), np.float64)
        return masked.ravel()

    def mean_square(self, difference: ArrayF64) -> float:
        return float((difference * difference).sum() / max(1.0, 3.0 * self._counts.sum()))

    def loss(self, pose: Camera) -> float:
        return self.mean_square(self.difference(pose))


def _descend(comparison: _Comparison, pose: Camera, distance: float, steps: int) -> Camera:
    """Return ``pose`` after ``steps`` steps. A step that does not lower the difference is not taken."""
    # Rotation (rad) and movement (scene units) that shift the image by a pixel.
    pixel = np.repeat([1.0 / pose.fx, distance / pose.fx], 3)
    residual = comparison.difference(pose)
    lowest = comparison.mean_square(residual)
    damping = 1e-3
    normal = gradient = None
    for _ in range(steps):
        if normal is None or gradient is None:
            probes = [
                comparison.difference(apply_twist(pose, axis))
                - comparison.difference(apply_twist(pose, -axis))
                for axis in np.diag(pixel * _DIFFERENCE)
            ]
            jacobian = np.stack(probes) / (2.0 * _DIFFERENCE)
            # einsum, not BLAS, whose order of summation depends on its threads.
            normal = np.einsum("im,jm->ij", jacobian, jacobian)
            gradient = np.einsum("im,m->i", jacobian, residual)
        damped = normal + np.diag(damping * normal.diagonal() + 1e-12)
        candidate = apply_twist(pose, -np.linalg.solve(damped, gradient) * pixel)
        tried = comparison.difference(candidate)
        if comparison.mean_square(tried) < lowest:
            pose, residual, lowest = candidate, tried, comparison.mean_square(tried)
            damping, normal = max(damping / 10.0, 1e-9), None
        else:
            damping = min(damping * 10.0, 1e9)
    return pose


def apply_twist(camera: Camera, twist: ArrayF64) -> Camera:
    """Return ``camera`` rotated (vector ``twist[:3]``) and moved (``twist[3:]``) in its own axes."""
    step = np.eye(4)
    step[:3, :3] = Rotation.from_rotvec(twist[:3]).as_matrix()
    step[:3, 3] = twist[3:]
    return replace(camera, world_to_camera=step @ camera.world_to_camera)


def rotation_between(a: ArrayF64, b: ArrayF64) -> float:  # [3, 3] each
    """Return the angle between two rotations, degrees."""
    return float(np.degrees(Rotation.from_matrix(a @ b.T).magnitude()))
