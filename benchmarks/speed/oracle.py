"""The error of a rasteriser against the float64 oracle, on pixels that brute force can afford.

On a large view the oracle renders some random pixels only, and the loss is a function of these pixels
alone. Nothing is approximated by it: a splat whose alpha stays under 1/255 at all of them adds exactly
nothing to their colours and gets exactly no gradient, so it is left out before the arithmetic starts.
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

PIXELS = 1000
"""The oracle renders at most so many random pixels,"""
PRODUCTS = 50_000_000
"""and at most so many (Gaussian, pixel) products (half a minute), as if every Gaussian were seen."""
MARGIN = 1e-3
"""Pixels where an alpha lies this close (relative) to 1/255, or a transmittance to 1e-4, are left out: there
the image jumps, and float32 may decide the other way. A mean at x = 1000 px is good to 3e-5 px in float32,
which moves the alpha of the narrowest splat at its rim by 2e-4."""


@dataclass(frozen=True)
class Error:
    """The largest and the median error of one quantity."""

    max: float
    median: float


@dataclass(frozen=True)
class Accuracy:
    """Errors against the oracle.

    ``image`` is absolute. Of a gradient ``max`` is the largest error over the largest gradient of that group,
    ``median`` is that of the elements' relative errors where the oracle's gradient is not zero.
    """

    image: Error
    gradients: dict[str, Error]
    pixels: int  # compared
    left_out: int  # too close to a cut-off
    left_out_max: float  # largest error of the image there
    gaussians: int  # that reach alpha 1/255 at a pixel of these
    seed: int

    @property
    def worst_gradient(self) -> float:
        """The largest of the groups' largest errors."""
        return max(error.max for error in self.gradients.values())


@dataclass(frozen=True, eq=False)
class Truth:
    """What the oracle says about some pixels of a view."""

    pixels: Tensor  # [S] y * width + x
    safe: Tensor  # [S] bool: not within MARGIN of a cut-off
    colours: Tensor  # [S, 3] float64
    grad_image: Tensor  # [H, W, 3] float32, zero but at the safe pixels; the loss is sum(grad_image * image)
    gradients: Gaussians  # float64, of all Gaussians
    seen: int  # Gaussians that reach alpha 1/255 at one of the pixels
    seed: int


def choose_pixels(camera: Camera, gaussians: int, seed: int) -> Tensor:
    """Different random pixels, as many as PIXELS and PRODUCTS allow: [S] y * width + x, ascending."""
    total = camera.width * camera.height
    number = min(total, PIXELS, max(1, PRODUCTS // max(1, gaussians)))
    chosen = np.random.default_rng(seed).choice(total, number, replace=False)
    return torch.from_numpy(np.sort(chosen))


def pixel_centres(pixels: Tensor, width: int) -> Tensor:
    """Coordinates [S, 2] float64 in px of pixels [S] numbered y * width + x."""
    return torch.stack([pixels % width, pixels // width], 1).double() + constants.PIXEL_CENTRE


def seen_at(gaussians: Gaussians, camera: Camera, pixels: Tensor) -> Tensor:
    """Indices, ascending, of the float64 Gaussians whose alpha reaches 1/255 at one of ``pixels`` or more."""
    in_front = in_depth_order(gaussians, camera)
    splats = reference.project(gaussians.detach(), camera, gaussians.sh.shape[1], antialias=False)
    centres = pixel_centres(pixels, camera.width)
    a, b, c = splats.conics.unbind(-1)
    # alpha >= 1/255 where half the quadratic form is at most this; a hair more, for the rounding.
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
    """The Gaussian that each row of ``reference.project`` belongs to, [M]."""
    # The oracle orders by depth alone, so Gaussians that carry their number as colour tell where they went.
    numbers = torch.arange(gaussians.num, dtype=torch.float64)
    tagged = Gaussians(
        **{
            **gaussians.detach().tensors(),
            "sh": (numbers / constants.SH_C0)[:, None, None].expand(-1, 1, 3),
        }
    )
    colours = reference.project(tagged, camera, 1, antialias=False).colours[:, 0]
    return (colours - constants.SH_OFFSET).round().long()


def oracle(gaussians: Gaussians, camera: Camera, pixels: Tensor, seed: int) -> Truth:
    """Colours of ``pixels`` over black and the gradients of a random linear functional of the safe ones.

    ``gaussians`` are float32 and taken as exact.
    """
    double = Gaussians(**{name: tensor.detach().double() for name, tensor in gaussians.tensors().items()})
    seen = seen_at(double, camera, pixels)
    leaves = Gaussians(**{k: t.clone().requires_grad_() for k, t in double.select(seen).tensors().items()})
    colours, margin = render_pixels(leaves, camera, pixels)
    safe = margin > MARGIN
    slope = torch.from_numpy(
        np.random.default_rng([seed, 1]).normal(size=(len(pixels), 3)).astype(np.float32)
    )
    slope[~safe] = 0.0
    (colours * slope.double()).sum().backward()  # type: ignore[no-untyped-call]  # torch's own
    full = {name: torch.zeros_like(tensor) for name, tensor in double.tensors().items()}
    for name, leaf in leaves.tensors().items():
        if leaf.grad is not None:
            full[name][seen] = leaf.grad
    grad_image = torch.zeros(camera.height * camera.width, 3)
    grad_image[pixels] = slope
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
    """The oracle's colours [S, 3] and margins [S] at ``pixels`` alone, differentiable in the parameters."""
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
    """Errors of an image [H, W, 3] and of the gradients for ``truth.grad_image``."""
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
    """Errors of one group of gradients as ``Accuracy`` defines them."""
    difference = (gradient.double() - exact).abs()
    some = exact != 0.0
    if not some.any():
        return Error(float(difference.max()), 0.0)
    relative = difference[some] / exact[some].abs()
    return Error(float(difference.max() / exact.abs().max()), float(relative.median()))
