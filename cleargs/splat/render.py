"""A view of a scene: as a function that torch can differentiate, and as a picture without gradients."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from cleargs.media.image import to_uint8
from cleargs.splat.backend import rasteriser_for
from cleargs.splat.camera import Camera
from cleargs.splat.gaussians import Gaussians
from cleargs.splat.scene import Scene
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

    The device of the tensors chooses the kernels. Every call allocates its own buffers: for training loops
    use ``Rasteriser``.

    Raises:
        InputError: when there is no back end for the device, the parameters are not float32, or the SH degree
            is not stored.
        StageError: when there are more (tile, splat) pairs than 2^31 - 1, or than fit in memory.
    """
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


class Viewer:
    """Renders one scene."""

    def __init__(self, scene: Scene, device: str = "cpu") -> None:
        self._scene = scene.to(device)
        self._engine = rasteriser_for(device)

    def view(
        self, camera: Camera, affine: NDArray[np.float64] | None = None
    ) -> NDArray[np.uint8]:  # [H, W, 3] sRGB
        """What ``camera`` sees, its colours through ``affine`` [3, 4] if there is one."""
        image = self.render(camera, self._scene.background).image.cpu().numpy()
        if affine is not None:
            image = image @ affine[:, :3].T.astype(np.float32) + affine[:, 3].astype(np.float32)
        return to_uint8(image)

    def render(self, camera: Camera, background: tuple[float, float, float], depth: bool = False) -> Render:
        """Image, alpha and, where it is asked for, accumulated depth over ``background``."""
        scene = self._scene
        return self._engine.forward(
            scene.gaussians, camera, background=background, antialias=scene.antialias, depth=depth
        )
