"""Render a view of a scene: as a differentiable torch function, or as an image without gradients."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from cleargs.splat.backend import rasteriser_for
from cleargs.splat.camera import Camera
from cleargs.splat.gaussians import Gaussians
from cleargs.splat.scene import Scene
from cleargs.splat.types import Render
from cleargs.types import ArrayF64, ImageU8


def render(
    gaussians: Gaussians,  # float32
    camera: Camera,
    *,
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),  # sRGB behind the Gaussians, from 0 to 1
    sh_degree: int | None = None,  # largest SH degree in use; None: the stored one
    antialias: bool = False,  # apply the opacity compensation of Mip-Splatting (Yu et al. 2024)
) -> Render:
    """Render image, alpha and depth, differentiable in the five parameters.

    The device of the tensors chooses the kernels. Each call allocates its own buffers: use `Rasteriser` for
    training loops. The image is not clamped above 1. Divide the accumulated depth by alpha for a mean.

    Raises:
        InputError: There is no back end for the device, the parameters are not float32, or the SH degree is
            not stored.
        StageError: There are more than 2^31 - 1 (tile, splat) pairs, or more than fit in memory.
    """
    outputs: tuple[Tensor, Tensor, Tensor] = _Rasterise.apply(  # type: ignore[no-untyped-call]  # torch's own
        *gaussians.tensors().values(), camera, background, sh_degree, antialias
    )
    return Render(*outputs)


class _Rasterise(torch.autograd.Function):
    """Autograd function of a rasteriser. Each call has its own rasteriser, which keeps the buffers alive."""

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
        ctx.saved_tensors  # noqa: B018  # raises if a parameter was changed in place since forward
        gradients = ctx.engine.backward(*grad_outputs)
        # Copies: autograd may keep the tensors as .grad while a second backward fills the buffers again.
        return (*gradients.clone().tensors().values(), None, None, None, None)


class Viewer:
    """Renderer of one scene, without gradients."""

    def __init__(self, scene: Scene, device: str = "cpu") -> None:
        self._scene = scene.to(device)
        self._engine = rasteriser_for(device)

    def view(self, camera: Camera, affine: ArrayF64 | None = None) -> ImageU8:
        """Render an 8-bit image [H, W, 3]; ``affine`` [3, 4], if given, transforms its sRGB colours."""
        from cleargs.media.image import to_uint8  # imports OpenCV, which `render` does not need

        image = self.render(camera, self._scene.background).image.cpu().numpy()
        if affine is not None:
            image = image @ affine[:, :3].T.astype(np.float32) + affine[:, 3].astype(np.float32)
        return to_uint8(image)

    def render(self, camera: Camera, background: tuple[float, float, float], depth: bool = False) -> Render:
        """Render image, alpha and, if ``depth`` is set, accumulated depth over ``background`` (sRGB)."""
        return self._engine.view(replace(self._scene, background=background), camera, depth=depth)
