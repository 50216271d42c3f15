"""Which kernels compute: the only choice between the CPU, a GPU, and what another package brings."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Protocol

import torch
from torch import Tensor

from cleargs.errors import InputError
from cleargs.plugins import plugin
from cleargs.splat.camera import Camera
from cleargs.splat.gaussians import Gaussians
from cleargs.splat.kernels.cuda import support
from cleargs.splat.kernels.warp_layout import DisplacementFields

if TYPE_CHECKING:
    from cleargs.splat.adam import Moments
    from cleargs.splat.kernels.cuda.loss import Meter
    from cleargs.splat.losses import PhotometricLoss


class Rasteriser(Protocol):
    """Renders and differentiates views; outputs may be views that the next call overwrites."""

    radii: Tensor

    def forward(
        self,
        gaussians: Gaussians,
        camera: Camera,
        *,
        sh_count: int,
        background: tuple[float, float, float],
        antialias: bool,
        depth: bool,
    ) -> tuple[Tensor, Tensor, Tensor | None]: ...

    def backward(
        self, grad_image: Tensor, grad_alpha: Tensor | None, grad_depth: Tensor | None
    ) -> Gaussians: ...

    def screen_gradients(self) -> Tensor:
        """dL/d(projected mean) [N, 2] of the last `backward`, by px."""
        ...


class Backend(Protocol):
    """The kernels of one kind of device; `cleargs.splat.kernels.cpu.backend` and ``cuda.backend`` are two.

    What is called like a function of `cleargs.splat.losses`, ``adam``, `cleargs.formation.exposure` or
    ``warp`` does what that function says. No sum depends on an order that may change. Tensors lie on the
    device.
    """

    def rasteriser(self, device: torch.device) -> Rasteriser:
        """Raises InputError where the device cannot be used."""
        ...

    def warm_up(self) -> None:
        """Compile what would otherwise be compiled within the first steps of a training."""
        ...

    def photometric_loss(
        self,
        image: Tensor,
        target: Tensor,
        *,
        ssim_lambda: float,
        weight: float,
        mask: Tensor | None,
        gradient: Tensor,
    ) -> PhotometricLoss: ...

    def psnr(self, image: Tensor, target: Tensor, mask: Tensor | None) -> float: ...

    def meter(self, ssim_lambda: float) -> Meter | None:
        """Keeps the losses of some steps where they are; None where they are known at once."""
        ...

    def adam_step(
        self,
        parameter: Tensor,
        gradient: Tensor,
        first_moment: Tensor,
        second_moment: Tensor,
        *,
        step: int,
        lr: float | Tensor,
        betas: tuple[float, float],
        eps: float,
    ) -> None: ...

    def regularise(self, gaussians: Gaussians, gradients: Gaussians, *, opacity: float, scale: float) -> None:
        """Add to the gradients those of opacity * mean(opacity) + scale * mean(scale) (3DGS-MCMC)."""
        ...

    def refine(
        self,
        gaussians: Gaussians,
        moments: Moments,
        *,
        errors: Tensor,
        rate: float,
        budget: int,
        min_opacity: float,
        seed: Sequence[int],
    ) -> tuple[Gaussians, Moments]:
        """A refinement by the rules of `strategy.mcmc`. What is given must not be used again."""
        ...

    def add_position_noise(
        self, gaussians: Gaussians, *, amount: float, min_opacity: float, seed: Sequence[int]
    ) -> None:
        """The noise of one step on the means, by the same rules, in place."""
        ...

    def apply_affine(self, image: Tensor, affine: Tensor) -> Tensor: ...

    def affine_backward(
        self, image: Tensor, affine: Tensor, grad_output: Tensor
    ) -> tuple[Tensor, Tensor]: ...

    def displacements(
        self, depth: Tensor, alpha: Tensor, motion: Tensor, *, margin: int
    ) -> DisplacementFields:
        """`displacement_fields` of a motion in numbers [25], which lie on the CPU: see ``warp_layout``."""
        ...

    def expose(self, image: Tensor, fields: DisplacementFields, samples: Tensor, *, margin: int) -> Tensor:
        """`Warp.forward`, by sample times and disc points [K, 3]."""
        ...

    def expose_backward(
        self, light: Tensor, fields: DisplacementFields, samples: Tensor, *, margin: int
    ) -> Tensor:
        """`Warp.transpose`."""
        ...

    def through_curve(self, image: Tensor, curve: Tensor, channels: int) -> tuple[Tensor, Tensor]: ...

    def times_slope(self, light: Tensor, slope: Tensor, channels: int) -> Tensor: ...


def backend_for(device: torch.device | str) -> Backend:
    """The kernels for a device. Raises InputError where there are none."""
    device = torch.device(device)
    if support.on_gpu(device):
        try:
            from cleargs.splat.kernels.cuda import backend as gpu
        except ImportError:
            support.require(device)  # says what is missing
            raise
        return gpu
    if device.type == "cpu":
        from cleargs.splat.kernels.cpu import backend as cpu

        return cpu
    if (found := plugin("backends", device.type)) is not None:
        backend: Backend = found.load()
        return backend
    raise InputError(f"there is no {device.type} back end for the splatting kernels", hint="use --device cpu")
