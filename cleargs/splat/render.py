"""``render``: a view of a scene as a function that torch can differentiate."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from cleargs.splat.backend import rasteriser_for
from cleargs.splat.camera import Camera
from cleargs.splat.gaussians import Gaussians
from cleargs.splat.kernels.rasteriser import sh_count
from cleargs.splat.types import Render


def render(
    gaussians: Gaussians,
    camera: Camera,
    *,
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
    sh_degree: int | None = None,
    antialias: bool = False,
) -> Render:
    """Render image [H, W, 3], alpha [H, W] and depth [H, W], differentiable in the five parameters.

    The image is sRGB as the scene stores it, over ``background``, not clamped above 1. The depth is
    accumulated: the sum of weight times camera z, so divide by alpha for a mean. ``sh_degree`` limits the
    SH degree (None: all that is stored). ``antialias`` applies the opacity compensation of Mip-Splatting.

    The device of the tensors chooses the kernels; float64 tensors go to the brute-force reference.
    Every call allocates its own buffers: for training loops use ``Rasteriser``.

    Raises:
        InputError: when there is no back end for the device or the SH degree is not stored.
        StageError: when there are more (tile, splat) pairs than 2^31 - 1, or than fit in memory.
    """
    if gaussians.means.dtype == torch.float64:
        from cleargs.splat.kernels import reference

        result = reference.render(
            gaussians,
            camera,
            background=background,
            sh_count=sh_count(gaussians, sh_degree),
            antialias=antialias,
        )
        return Render(result.image, result.alpha, result.depth)
    outputs: tuple[Tensor, Tensor, Tensor] = _Rasterise.apply(  # type: ignore[no-untyped-call]  # torch's own
        *gaussians.tensors().values(), camera, background, sh_degree, antialias
    )
    return Render(*outputs)


class _Rasterise(torch.autograd.Function):
    """Hands ``Rasteriser`` to autograd. Each call has an engine of its own, which keeps its buffers alive."""

    @staticmethod
    def forward(ctx: Any, *inputs: Any) -> tuple[Tensor, Tensor, Tensor]:
        *parameters, camera, background, sh_degree, antialias = inputs
        engine = rasteriser_for(parameters[0].device)
        image, alpha, depth = engine.forward(
            Gaussians(*parameters),
            camera,
            sh_degree=sh_degree,
            background=background,
            antialias=antialias,
            depth=True,
        )
        assert depth is not None
        ctx.engine = engine
        ctx.save_for_backward(*parameters)
        return image, alpha, depth

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Any) -> tuple[Tensor | None, ...]:
        ctx.saved_tensors  # noqa: B018  # raises when a parameter was changed in place since forward
        gradients = ctx.engine.backward(*grad_outputs)
        # Copies: autograd may keep the tensors as .grad while a second backward fills the buffers again.
        return (*gradients.clone().tensors().values(), None, None, None, None)
