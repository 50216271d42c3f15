"""Error of a rasteriser against the float64 oracle on random pixels.

The oracle is slow. So on a large view it renders only some random pixels, and the loss depends only on these
pixels. This is exact: a splat with an alpha below 1/255 at all of them adds nothing to their colours and gets
a zero gradient, so it is left out.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from benchmarks.speed import reference
from cleargs.splat import constants
from cleargs.splat.camera import Camera
from cleargs.splat.gaussians import Gaussians

MAX_PIXELS = 1000
"""Maximum number of random pixels that the oracle renders."""
MAX_PRODUCTS = 50_000_000
"""Maximum number of (Gaussian, pixel) products, counting all Gaussians. They take half a minute."""
MARGIN = 1e-3
"""Relative distance of an alpha from 1/255, or of a transmittance from 1e-4, below which a pixel is left out:
the image is discontinuous there, and float32 may fall on the other side. A mean at x = 1000 px has an error
of 3e-5 px in float32, which changes the alpha at the rim of the narrowest splat by 2e-4."""


@dataclass(frozen=True)
class Error:
    """Largest and median error of one quantity."""

    max: float
    median: float


@dataclass(frozen=True)
class Accuracy:
    """Errors against the oracle.

    Those of ``image`` are absolute. For a group of gradients, ``max`` is the largest error / the largest
    gradient of the group, and ``median`` is over the relative errors of all elements with a nonzero gradient.
    """

    image: Error
    gradients: dict[str, Error]
    pixels: int  # compared
    left_out: int  # pixels too close to a cut-off
    left_out_max: float  # largest error of the image at these
    gaussians: int  # with an alpha of at least 1/255 at one of the pixels
    seed: int

    @property
    def worst_gradient(self) -> float:
        """Largest error of all groups of gradients."""
        return max(error.max for error in self.gradients.values())


@dataclass(frozen=True, eq=False)
class Truth:
    """Values of the oracle for some pixels of a view."""

    pixels: Tensor  # [S] y * width + x
    safe: Tensor  # [S] bool: farther than MARGIN from a cut-off
    colours: Tensor  # [S, 3] float64
    grad_image: Tensor  # [H, W, 3] float32, zero except at safe pixels; loss = sum(grad_image * image)
    gradients: Gaussians  # float64, of all Gaussians
    seen: int  # Gaussians with an alpha of at least 1/255 at one of the pixels
    seed: int


def choose_pixels(camera: Camera, gaussians: int, seed: int) -> Tensor:
    """Return different random pixels [S], y * width + x in ascending order.

    `MAX_PIXELS` and `MAX_PRODUCTS` limit their number.
    """
    total = camera.width * camera.height
    number = min(total, MAX_PIXELS, max(1, MAX_PRODUCTS // max(1, gaussians)))
    chosen = np.random.default_rng(seed).choice(total, number, replace=False)
    return torch.from_numpy(np.sort(chosen))


def pixel_centres(pixels: Tensor, width: int) -> Tensor:
    """Return the centres [S, 2] of ``pixels`` [S], float64 px."""
    return torch.stack([pixels % width, pixels // width], 1).double() + constants.PIXEL_CENTRE


def seen_at(gaussians: Gaussians, camera: Camera, pixels: Tensor) -> Tensor:
    """Return ascending indices of the float64 Gaussians whose alpha reaches 1/255 at one of ``pixels``."""
    in_front = in_depth_order(gaussians, camera)
    splats = reference.project(gaussians.detach(), camera, gaussians.sh.shape[1], antialias=False)
    centres = pixel_centres(pixels, camera.width)
    a, b, c = splats.conics.unbind(-1)
    # alpha >= 1/255 if half the quadratic form is at most this; 1e-9 covers rounding.
    reach = torch.log(splats.opacities / constants.ALPHA_CUT) + 1e-9
    seen = torch.zeros(len(reach), dtype=torch.bool)
    step = max(1, reference.CHUNK // len(centres))
    for start in range(0, len(reach), step):
        part = slice(start, start + step)
        dx, dy = (centres[None, :, axis] - splats.means[part, axis, None] for axis in (0, 1))
        power = 0.5 * (a[part, None] * dx * dx + c[part, None] * dy * dy) + b[part, None] * dx * dy
        seen[part] = (power <= reach[part, None]).any(1)
    return in_front[seen].sort().values


def in_depth_order(gaussians: Gaussians, camera: Camera) -> Tensor:
    """Return the index [M] of the Gaussian behind each row of ``reference.project``."""
    # The oracle sorts by depth only. So Gaussians whose colour is their index reveal the order.
    numbers = torch.arange(gaussians.num, dtype=torch.float64)
    tagged = Gaussians(
        **{**gaussians.detach().tensors(), "sh": (numbers / constants.SH_C0)[:, None, None].expand(-1, 1, 3)}
    )
    colours = reference.project(tagged, camera, 1, antialias=False).colours[:, 0]
    return (colours - constants.SH_OFFSET).round().long()


def oracle(gaussians: Gaussians, camera: Camera, pixels: Tensor, seed: int) -> Truth:
    """Render ``pixels`` over black, and differentiate a random linear functional of the safe ones.

    Args:
        gaussians: Float32 Gaussians; their values count as exact.
        camera: The view.
        pixels: Pixels [S], y * width + x.
        seed: Seed of the functional.
    """
    double = Gaussians(**{name: tensor.detach().double() for name, tensor in gaussians.tensors().items()})
    seen = seen_at(double, camera, pixels)
    leaves = Gaussians(**{k: t.clone().requires_grad_() for k, t in double.select(seen).tensors().items()})
    colours, margin = render_pixels(leaves, camera, pixels)
    safe = margin > MARGIN
    weights = torch.from_numpy(
        np.random.default_rng([seed, 1]).normal(size=(len(pixels), 3)).astype(np.float32)
    )
    weights[~safe] = 0.0
    (colours * weights.double()).sum().backward()  # type: ignore[no-untyped-call]  # torch's own
    full = {name: torch.zeros_like(tensor) for name, tensor in double.tensors().items()}
    for name, leaf in leaves.tensors().items():
        if leaf.grad is not None:
            full[name][seen] = leaf.grad
    grad_image = torch.zeros(camera.height * camera.width, 3)
    grad_image[pixels] = weights
    return Truth(
        pixels=pixels,
        safe=safe,
        colours=colours.detach(),
        grad_image=grad_image.reshape(camera.height, camera.width, 3),
        gradients=Gaussians(**full),
        seen=len(seen),
        seed=seed,
    )


def render_pixels(gaussians: Gaussians, camera: Camera, pixels: Tensor) -> tuple[Tensor, Tensor]:
    """Return the oracle's colours [S, 3] and margins [S] at ``pixels``, differentiable in the parameters."""
    splats = reference.project(gaussians, camera, gaussians.sh.shape[1], antialias=False)
    background = torch.zeros(3, dtype=torch.float64)
    if len(splats.depths) == 0:
        nothing = torch.zeros(len(pixels), 3, dtype=torch.float64) + gaussians.means.sum() * 0.0
        return nothing, torch.full((len(pixels),), torch.inf, dtype=torch.float64)
    centres = pixel_centres(pixels, camera.width)
    parts = [
        checkpoint(reference.blend, splats, chunk, background, use_reentrant=False)
        for chunk in torch.split(centres, max(1, reference.CHUNK // len(splats.depths)))
    ]
    return torch.cat([part[0] for part in parts]), torch.cat([part[3] for part in parts])


def accuracy(truth: Truth, image: Tensor, gradients: Gaussians) -> Accuracy:
    """Return the errors of an image [H, W, 3] and of the gradients for ``truth.grad_image``."""
    difference = (image.reshape(-1, 3)[truth.pixels].double() - truth.colours).abs()
    inside, outside = difference[truth.safe], difference[~truth.safe]
    return Accuracy(
        image=Error(float(inside.max()), float(inside.median())),
        gradients={
            name: gradient_error(gradients.tensors()[name], exact)
            for name, exact in truth.gradients.tensors().items()
        },
        pixels=len(inside),
        left_out=len(outside),
        left_out_max=float(outside.max()) if len(outside) else 0.0,
        gaussians=truth.seen,
        seed=truth.seed,
    )


def gradient_error(gradient: Tensor, exact: Tensor) -> Error:
    """Return the errors of one group of gradients, as defined by `Accuracy`."""
    difference = (gradient.double() - exact).abs()
    some = exact != 0.0
    if not some.any():
        return Error(float(difference.max()), 0.0)
    relative = difference[some] / exact[some].abs()
    return Error(float(difference.max() / exact.abs().max()), float(relative.median()))
