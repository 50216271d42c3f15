"""Similarity transforms of scenes, and rotations to worlds with a given up axis."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from torch import Tensor

from cleargs.errors import InputError
from cleargs.splat.camera import Camera
from cleargs.splat.constants import SH_C0, SH_C1, SH_C2, SH_C3
from cleargs.splat.gaussians import Gaussians
from cleargs.splat.scene import Scene

MAX_REACH = 1e18
"""Upper limit of a scene's largest coordinate; the inverse is the lower limit. The squares fit in float32."""

UP: Mapping[str, tuple[tuple[float, ...], ...]] = {
    "-y": ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    "y": ((1, 0, 0), (0, -1, 0), (0, 0, -1)),
    "z": ((1, 0, 0), (0, 0, 1), (0, -1, 0)),
}
"""Up axis -> rotation matrix from a world with x right, y down, z forward. The first camera looks along -z in
programs with y up, and along y in programs with z up."""

_DIRECTIONS = 64
"""Number of directions in which two SH functions are compared; 16 coefficients need at least 16."""


ROUNDED = 0.1
"""Largest acceptable rounding step of float32 positions, as a share of the median size of the Gaussians."""


def far_offset(gaussians: Gaussians, similarity: Mapping[str, Any]) -> list[float]:
    """Return the whole units to leave out of the translation of ``similarity``; empty if float32 suffices.

    Map coordinates (UTM) reach millions of metres, where float32 has steps of half a metre.
    """
    translation = np.asarray(similarity["translation"], np.float64)
    size = float(similarity["scale"]) * float(torch.exp(gaussians.log_scales.median()))
    step = float(np.spacing(np.float32(np.abs(translation).max())))
    return np.round(translation).tolist() if step > ROUNDED * size else []


def transform_scene(
    scene: Scene,
    *,
    scale: float,
    rotation: NDArray[np.float64],  # [3, 3]
    translation: NDArray[np.float64],  # [3]
) -> Scene:
    """Apply the similarity x -> scale rotation x + translation to a scene, which is not changed.

    Cameras that are transformed in the same way see the same images. The computation is in float64 and the
    result in float32, like the files. A translation much larger than the scene therefore reduces the
    precision of the means.

    Raises:
        ValueError: The transform is not a similarity: ``scale`` is not positive, or ``rotation`` not proper.
        InputError: The result exceeds the range of float32.
    """
    if (
        scale <= 0
        or not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-6)
        or np.linalg.det(rotation) < 0
    ):
        raise ValueError("not a similarity: the scale must be positive, the rotation proper")
    gaussians = scene.gaussians.detach()
    turn = torch.from_numpy(np.ascontiguousarray(rotation, dtype=np.float64))
    shift = torch.from_numpy(np.asarray(translation, dtype=np.float64))
    means = scale * gaussians.means.double() @ turn.T + shift
    quaternion = np.roll(Rotation.from_matrix(rotation).as_quat(), 1)  # x y z w -> w x y z
    mixing = sh_rotation(turn, gaussians.sh.shape[1])
    transformed = Gaussians(
        means=means.float(),
        log_scales=(gaussians.log_scales.double() + math.log(scale)).float(),
        rotations=_multiply(torch.from_numpy(quaternion), gaussians.rotations.double()).float(),
        logit_opacities=gaussians.logit_opacities.clone(),
        sh=torch.einsum("jk,nkc->njc", mixing, gaussians.sh.double()).float().contiguous(),
    )
    reach, before = (float(g.means.abs().max()) if g.num else 1.0 for g in (transformed, gaussians))
    if transformed.fault() or reach > MAX_REACH or (before > 0.0 and reach < 1.0 / MAX_REACH):
        raise InputError(
            "the coordinates of the scene in that world exceed the range of float32",
            hint="export the scene in the normalised world (without --world input)",
        )
    return replace(scene, gaussians=transformed)


def sh_basis(directions: Tensor, count: int) -> Tensor:
    """Evaluate the first ``count`` real spherical harmonics [N, count] at unit directions [N, 3]."""
    x, y, z = directions.unbind(-1)
    xx, yy, zz = x * x, y * y, z * z
    c1, c2, c3 = SH_C1, SH_C2, SH_C3
    basis = [
        torch.full_like(x, SH_C0),
        -c1 * y,
        c1 * z,
        -c1 * x,
        c2[0] * x * y,
        c2[1] * y * z,
        c2[2] * (2 * zz - xx - yy),
        c2[3] * x * z,
        c2[4] * (xx - yy),
        c3[0] * y * (3 * xx - yy),
        c3[1] * x * y * z,
        c3[2] * y * (4 * zz - xx - yy),
        c3[3] * z * (2 * zz - 3 * xx - 3 * yy),
        c3[4] * x * (4 * zz - xx - yy),
        c3[5] * z * (xx - yy),
        c3[6] * x * (xx - 3 * yy),
    ]
    return torch.stack(basis[:count], -1)


def sh_rotation(rotation: Tensor, count: int) -> Tensor:
    """Return the matrix that maps the SH coefficients of a function f to those of d -> f(rotationᵀ d).

    A rotated harmonic is a sum of harmonics of the same degree. The coefficients (1, 4, 9 or 16) therefore
    follow exactly, up to rounding, from the values in enough directions (least squares, in float64).
    """
    # A Fibonacci sphere: its directions are evenly spread, so the least squares are well conditioned.
    index = torch.arange(_DIRECTIONS, dtype=torch.float64) + 0.5
    z = 1.0 - 2.0 * index / _DIRECTIONS
    angle = index * math.pi * (3.0 - math.sqrt(5.0))
    ring = torch.sqrt(1.0 - z * z)
    directions = torch.stack([ring * torch.cos(angle), ring * torch.sin(angle), z], dim=1)
    mixing: Tensor = torch.linalg.lstsq(
        sh_basis(directions, count), sh_basis(directions @ rotation, count)
    ).solution
    return mixing


def _multiply(first: Tensor, second: Tensor) -> Tensor:
    """Return the Hamilton products [N, 4] of ``first`` [4] and ``second`` [N, 4]."""
    w, x, y, z = first
    matrix = torch.stack(
        [
            torch.stack([w, -x, -y, -z]),
            torch.stack([x, w, -z, y]),
            torch.stack([y, z, w, -x]),
            torch.stack([z, -y, x, w]),
        ]
    )
    return second @ matrix.T


def orient_up(first: Camera, up: str) -> dict[str, Any]:
    """Return the rigid transform from the normalised world (y down) to a world with another up axis of `UP`.

    In the new world ``first``, the first camera of the capture, is at the origin and looks ahead; its pitch
    and roll do not affect the up axis. The result holds the arguments of `transform_scene`.
    """
    ahead = first.world_to_camera[2, :3] * [1.0, 0.0, 1.0]
    length = float(np.linalg.norm(ahead))
    x, _, z = ahead / length if length > 1e-6 else (0.0, 0.0, 1.0)  # a camera that looks up or down: no turn
    rotation = np.array(UP[up]) @ [[z, 0.0, -x], [0.0, 1.0, 0.0], [x, 0.0, z]]
    return {"scale": 1.0, "rotation": rotation, "translation": -rotation @ first.centre}
