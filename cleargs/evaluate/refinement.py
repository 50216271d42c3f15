"""Test-pose refinement: the pose at which a scene explains a reference image best.

Levenberg-Marquardt on the photometric difference at a reduced size. The kernels give no gradient of the
camera, so the six columns of the Jacobian are central differences.
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
"""Gives [H, W, 3] sRGB in [0, 1]."""

LONG_SIDE = 320
"""Size at which images are compared, px."""

_BLUR = 1.0  # px; widens the reach of a step to a few pixels
_DIFFERENCE = 0.25  # px that a probing movement shifts the picture


def refine_pose(
    render: Render,
    camera: Camera,
    depth: float,
    reference: ImageU8,  # [H, W, 3]
    mask: MaskBool | None,  # [H, W] True = counts
    steps: int,
) -> tuple[Camera, Refinement]:
    """The camera with the pose that lowers the mean squared difference, after ``steps`` steps.

    ``depth`` is how far the scene typically is: it makes a unit of movement shift the picture as much as a
    unit of turning does. A step that does not lower the difference is not taken.
    """
    small = camera.scaled(min(1.0, LONG_SIDE / max(camera.width, camera.height)))
    size = (small.width, small.height)
    target = np.asarray(cv2.resize(reference / 255.0, size, interpolation=cv2.INTER_AREA))
    counts = np.ones(target.shape[:2])
    if mask is not None:  # where every pixel under a reduced one counts
        covered = cv2.resize(mask.astype(np.float64), size, interpolation=cv2.INTER_AREA)
        counts = (np.asarray(covered) > 0.999).astype(np.float64)
    pixel = np.repeat([1.0 / small.fx, depth / small.fx], 3)  # of turning (rad) and of moving (scene units)

    def difference(pose: Camera) -> ArrayF64:
        masked = (render(pose) - target) * counts[..., None]
        return np.asarray(cv2.GaussianBlur(masked, (0, 0), _BLUR), np.float64).ravel()

    def loss(residual: ArrayF64) -> float:
        return float((residual * residual).sum() / max(1.0, 3.0 * counts.sum()))

    pose, residual = small, difference(small)
    first = lowest = loss(residual)
    damping = 1e-3
    normal = gradient = None
    for _ in range(steps):
        if normal is None or gradient is None:
            jacobian = np.stack(
                [
                    difference(apply_twist(pose, axis)) - difference(apply_twist(pose, -axis))
                    for axis in np.diag(pixel * _DIFFERENCE)
                ]
            ) / (2.0 * _DIFFERENCE)
            # einsum, not BLAS, whose order of summation depends on its threads.
            normal = np.einsum("im,jm->ij", jacobian, jacobian)
            gradient = np.einsum("im,m->i", jacobian, residual)
        damped = normal + np.diag(damping * normal.diagonal() + 1e-12)
        candidate = apply_twist(pose, -np.linalg.solve(damped, gradient) * pixel)
        tried = difference(candidate)
        if loss(tried) < lowest:
            pose, residual, lowest = candidate, tried, loss(tried)
            damping, normal = max(damping / 10.0, 1e-9), None
        else:
            damping = min(damping * 10.0, 1e9)
    refined = replace(camera, world_to_camera=pose.world_to_camera)
    return refined, Refinement(
        rotation_deg=rotation_between(camera.world_to_camera[:3, :3], refined.world_to_camera[:3, :3]),
        shift=float(np.linalg.norm(refined.centre - camera.centre)),
        loss_before=first,
        loss_after=lowest,
    )


def apply_twist(camera: Camera, twist: ArrayF64) -> Camera:
    """``camera`` turned (``twist[:3]``, rotation vector) and moved (``twist[3:]``) in its own axes."""
    step = np.eye(4)
    step[:3, :3] = Rotation.from_rotvec(twist[:3]).as_matrix()
    step[:3, 3] = twist[3:]
    return replace(camera, world_to_camera=step @ camera.world_to_camera)


def rotation_between(a: ArrayF64, b: ArrayF64) -> float:  # [3, 3] each
    """Angle between two rotations, degrees."""
    return float(np.degrees(Rotation.from_matrix(a @ b.T).magnitude()))
