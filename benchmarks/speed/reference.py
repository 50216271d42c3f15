"""Reference renderer (oracle): every Gaussian at every pixel in float64 torch, with gradients by autograd.

It computes the image in the simplest way and shares only the constants with the kernels. Time and arithmetic
grow with pixels times Gaussians. Memory is bounded: rows of pixels are processed in chunks, which the
backward pass recomputes.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from cleargs.splat import constants
from cleargs.splat.camera import Camera
from cleargs.splat.gaussians import Gaussians
from cleargs.splat.transforms import sh_basis

CHUNK = 2_000_000
"""Largest number of (pixel, Gaussian) products in memory at a time."""


class ReferenceRender(NamedTuple):
    """A reference view; ``margin`` is the distance of each pixel from a discontinuity."""

    image: Tensor  # [H, W, 3]
    alpha: Tensor  # [H, W]
    depth: Tensor  # [H, W] sum of weight * z
    margin: Tensor  # [H, W] smallest relative distance of an alpha from 1/255 or of a T from 1e-4


class Splats(NamedTuple):
    """Visible Gaussians after projection, in depth order."""

    means: Tensor  # [M, 2] px
    conics: Tensor  # [M, 3] inverse covariance: xx, xy, yy
    colours: Tensor  # [M, 3]
    opacities: Tensor  # [M]
    depths: Tensor  # [M]


def rotation_matrices(quaternions: Tensor) -> Tensor:
    """Return the rotation matrices [N, 3, 3] of quaternions w x y z [N, 4] of any norm (zero: identity)."""
    unit = torch.nn.functional.normalize(quaternions, dim=-1, eps=constants.QUATERNION_EPSILON)
    w, x, y, z = unit.unbind(-1)
    rows = [
        torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], -1),
        torch.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], -1),
        torch.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], -1),
    ]
    return torch.stack(rows, -2)


def project(gaussians: Gaussians, camera: Camera, sh_count: int, antialias: bool) -> Splats:
    """Project, cull at the near plane and sort by (depth, index).

    Depths are compared as float32 by definition: the last bits of a float64 must not decide which of two
    splats is in front. The splats of a wall that faces the camera thus stay in the order of their indices.

    Args:
        gaussians: Float64 Gaussians.
        camera: Camera of the view.
        sh_count: Number of SH coefficients in use: 1, 4, 9 or 16.
        antialias: Apply the opacity compensation of Mip-Splatting.
    """
    pose = torch.as_tensor(camera.world_to_camera)
    rotation, translation = pose[:3, :3], pose[:3, 3]
    depths = gaussians.means.detach() @ rotation[2] + translation[2]
    visible = torch.nonzero(depths >= constants.NEAR).squeeze(1)
    visible = visible[torch.argsort(depths[visible].float(), stable=True)]
    means = gaussians.means[visible]
    x, y, z = (means @ rotation.T + translation).unbind(-1)

    beyond_x = constants.VIEW_CLAMP * 0.5 * camera.width / camera.fx
    beyond_y = constants.VIEW_CLAMP * 0.5 * camera.height / camera.fy
    tangent_x = (x / z).clamp(
        -camera.cx / camera.fx - beyond_x, (camera.width - camera.cx) / camera.fx + beyond_x
    )
    tangent_y = (y / z).clamp(
        -camera.cy / camera.fy - beyond_y, (camera.height - camera.cy) / camera.fy + beyond_y
    )
    zero = torch.zeros_like(z)
    jacobian = torch.stack(
        [
            torch.stack([camera.fx / z, zero, -camera.fx * tangent_x / z], -1),
            torch.stack([zero, camera.fy / z, -camera.fy * tangent_y / z], -1),
        ],
        -2,
    )
    scales = gaussians.log_scales[visible].exp()
    u = jacobian @ rotation @ rotation_matrices(gaussians.rotations[visible]) * scales[:, None, :]
    # Lagrange's identity has positive terms only, so the determinant is exact to rounding for needles, too.
    u0, u1 = u[:, 0], u[:, 1]
    area = torch.linalg.cross(u0, u1).square().sum(-1)
    xx, xy, yy = (u0 * u0).sum(-1), (u0 * u1).sum(-1), (u1 * u1).sum(-1)
    det = area + constants.DILATION * (xx + yy) + constants.DILATION**2
    conics = torch.stack([(yy + constants.DILATION) / det, -xy / det, (xx + constants.DILATION) / det], -1)
    opacities = torch.sigmoid(gaussians.logit_opacities[visible])
    if antialias:
        opacities = opacities * (area / det).sqrt()

    directions = torch.nn.functional.normalize(means - torch.as_tensor(camera.centre), dim=-1)
    coefficients = gaussians.sh[visible, :sh_count]
    colours = torch.einsum("nk,nkc->nc", sh_basis(directions, sh_count), coefficients)
    return Splats(
        means=torch.stack([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy], -1),
        conics=conics,
        colours=(colours + constants.SH_OFFSET).clamp_min(0.0),
        opacities=opacities,
        depths=z,
    )


def blend(splats: Splats, pixels: Tensor, background: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return colour [P, 3], alpha [P], depth [P] and margin [P] at pixel centres [P, 2] in px."""
    offsets = pixels[:, None, :] - splats.means[None]
    dx, dy = offsets.unbind(-1)
    a, b, c = splats.conics.unbind(-1)
    raw = splats.opacities * torch.exp(-0.5 * (a * dx * dx + 2 * b * dx * dy + c * dy * dy))
    alpha = torch.where(raw >= constants.ALPHA_CUT, raw.clamp_max(constants.ALPHA_MAX), 0.0)
    after = torch.cumprod(1 - alpha, dim=1)
    kept = after >= constants.TRANSMITTANCE_STOP  # monotone: once false, it is false for all later splats
    alpha = torch.where(kept, alpha, 0.0)
    after = torch.cumprod(1 - alpha, dim=1)
    before = torch.cat([torch.ones_like(after[:, :1]), after[:, :-1]], dim=1)
    weights = alpha * before
    rest = after[:, -1]
    with torch.no_grad():
        cut = (raw / constants.ALPHA_CUT - 1).abs()
        stop = (
            torch.cumprod(1 - torch.where(raw >= constants.ALPHA_CUT, raw, 0.0), 1)
            / constants.TRANSMITTANCE_STOP
            - 1
        ).abs()
        margin = torch.minimum(cut, stop).amin(dim=1)
    colours = weights @ splats.colours + rest[:, None] * background
    return colours, 1 - rest, weights @ splats.depths, margin


def render(
    gaussians: Gaussians,
    camera: Camera,
    *,
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
    sh_count: int = 16,
    antialias: bool = False,
) -> ReferenceRender:
    """Render a view of float64 Gaussians with ``sh_count`` coefficients, as `cleargs.splat.render.render`."""
    splats = project(gaussians, camera, sh_count, antialias)
    colour = torch.tensor(background, dtype=torch.float64)
    height, width = camera.height, camera.width
    if len(splats.depths) == 0:
        # The products keep the result connected to the parameters, so that backward gives zeros.
        nothing = sum((tensor.sum() * 0.0 for tensor in gaussians.tensors().values()), torch.zeros(()))
        empty = torch.zeros(height, width, dtype=torch.float64) + nothing
        return ReferenceRender(
            empty[..., None] + colour, empty, empty.clone(), torch.full_like(empty, math.inf)
        )

    rows = max(1, CHUNK // (width * len(splats.depths)))
    xs = torch.arange(width, dtype=torch.float64) + constants.PIXEL_CENTRE
    chunks = []
    for top in range(0, height, rows):
        ys = torch.arange(top, min(height, top + rows), dtype=torch.float64) + constants.PIXEL_CENTRE
        pixels = torch.stack(torch.meshgrid(xs, ys, indexing="xy"), -1).reshape(-1, 2)
        chunks.append(checkpoint(blend, splats, pixels, colour, use_reentrant=False))
    image, alpha, depth, margin = (torch.cat(parts) for parts in zip(*chunks, strict=True))
    return ReferenceRender(
        image.reshape(height, width, 3),
        alpha.reshape(height, width),
        depth.reshape(height, width),
        margin.reshape(height, width),
    )
