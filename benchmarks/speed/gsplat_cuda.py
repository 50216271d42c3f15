"""gsplat's CUDA rasteriser on the same splats, for the comparison on a GPU."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from benchmarks.speed.random_scenes import random_image
from benchmarks.speed.timing import Clock
from cleargs.splat.camera import Camera
from cleargs.splat.gaussians import Gaussians


def load_gsplat() -> Any:
    """Import gsplat with its kernels; raise ImportError with the reason if they are unavailable."""
    try:
        import gsplat
        from gsplat.cuda._backend import _C
    except Exception as error:  # any cause: a missing compiler, version or header
        raise ImportError(f"{type(error).__name__}: {str(error).strip()[:200]}") from error
    if _C is None:
        raise ImportError("its kernels were not built")
    return gsplat


class GsplatRasteriser:
    """Forward and backward pass with autograd, from the raw parameters as in a training."""

    def __init__(self, gsplat: Any, gaussians: Gaussians, camera: Camera, device: torch.device) -> None:
        self._gsplat = gsplat
        tensors = gaussians.tensors().values()
        self._leaves = Gaussians(*(tensor.to(device, copy=True).requires_grad_() for tensor in tensors))
        self._camera = camera
        self._view = torch.as_tensor(camera.world_to_camera, dtype=torch.float32).to(device)[None]
        intrinsics = [[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]]
        self._intrinsics = torch.tensor(intrinsics, device=device)[None]
        self._gradient = random_image(camera.width, camera.height).to(device)

    def run_several(self, repetitions: int, clock: Clock) -> None:
        """Time ``repetitions`` forward and backward passes."""
        for _ in range(repetitions):
            with clock.repetition():
                with clock.time("forward"):
                    image = self._render()
                with clock.time("backward"):
                    self._gradients(image, self._gradient)

    def image_and_gradients(self, grad_image: Tensor) -> tuple[Tensor, Gaussians]:
        """Return the image [H, W, 3] and the gradients for dL/d(image) [H, W, 3], on the CPU."""
        image = self._render()
        gradients = self._gradients(image, grad_image.to(image.device))
        return image.detach().cpu(), Gaussians(*(gradient.cpu() for gradient in gradients))

    def _gradients(self, image: Tensor, grad_image: Tensor) -> tuple[Tensor, ...]:
        return torch.autograd.grad(image, list(self._leaves.tensors().values()), grad_image)

    def _render(self) -> Tensor:
        leaves, camera = self._leaves, self._camera
        images, _, _ = self._gsplat.rasterization(
            leaves.means,
            leaves.rotations,
            leaves.log_scales.exp(),
            leaves.logit_opacities.sigmoid(),
            leaves.sh,
            self._view,
            self._intrinsics,
            camera.width,
            camera.height,
            sh_degree=leaves.sh_degree,
            packed=False,
        )
        image: Tensor = images[0]
        return image
