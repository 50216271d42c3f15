"""Which kernels compute: the only choice between the CPU, a GPU, and what another package brings."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import torch
from torch import Tensor

from cleargs.errors import InputError
from cleargs.splat.gaussians import Gaussians
from cleargs.splat.kernels.cuda import support
from cleargs.splat.kernels.rasteriser import Rasteriser
from cleargs.splat.kernels.warp_layout import DisplacementFields
from cleargs.splat.types import AdamStep, Moments, PhotometricLoss, Reading


class Meter(Protocol):
    """The losses of some steps, kept on a device until they are read together."""

    def __len__(self) -> int:
        """Number of steps that wait to be read."""
        ...

    def add(
        self,
        step: int,
        image: Tensor,
        target: Tensor,
        mask: Tensor | None,
        *,
        weight: float,
        gradient: Tensor,
    ) -> None:
        """Write the gradient of a step's loss (see `photometric_loss`) and keep its sums."""
        ...

    def take(self) -> Sequence[tuple[int, Reading]]:
        """What waits, by step, and forget it."""
        ...


class Backend(Protocol):
    """The kernels of one kind of device; `cleargs.splat.kernels.cpu.backend` and ``cuda.backend`` are two.

    What is called like a function of this module, of `cleargs.formation.exposure` or of ``warp`` does what
    that function says. No sum depends on an order that may change. Tensors lie on the device.
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

    def adam_step(self, step: AdamStep) -> None: ...

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
        """A refinement by `cleargs.splat.strategy.rules`. What is given must not be used again."""
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
    raise InputError(f"there is no {device.type} back end for the splatting kernels", hint="use --device cpu")


def set_threads(n: int) -> None:
    """Run the CPU's kernels on ``n`` threads from now on (for the calling Python thread).

    At most as many as Numba started, which is the number of cores or ``NUMBA_NUM_THREADS``. Results do
    not depend on it. torch's threads are set on their own, by ``torch.set_num_threads``.

    Raises:
        ValueError: when ``n`` is less than 1.
    """
    from cleargs.splat.kernels.cpu import launch

    launch.set_threads(n)


def rasteriser_for(device: torch.device | str = "cpu") -> Rasteriser:
    """A rasteriser on a device. Raises InputError where there is none."""
    return backend_for(device).rasteriser(torch.device(device))


def adam_step(step: AdamStep) -> None:
    """Do a step of Adam, in place."""
    if step.parameter.numel():
        backend_for(step.parameter.device).adam_step(step)


def step_gaussians(
    gaussians: Gaussians,
    gradients: Gaussians,
    moments: Moments,
    rates: dict[str, float | Tensor],
    *,
    step: int,
) -> None:
    """One Adam step of every group in place; ``step`` counts from 1 (bias correction)."""
    slopes = gradients.tensors()
    for name, parameter in gaussians.tensors().items():
        adam_step(
            AdamStep(parameter, slopes[name], moments.first[name], moments.second[name], step, rates[name])
        )


def photometric_loss(
    image: Tensor,  # [H, W, 3]
    target: Tensor,  # [H, W, 3]
    *,
    ssim_lambda: float,
    weight: float = 1.0,
    mask: Tensor | None = None,  # [H, W] bool, True = counts
    gradient: Tensor | None = None,  # [H, W, 3] written and returned, where given
) -> PhotometricLoss:
    """L1 + D-SSIM of 3DGS and its gradient with respect to ``image``, without autograd.

    SSIM has an 11 x 11 Gaussian window of sigma 1.5 and zero padding, as in the Inria code.
    Means run over the pixels that ``mask`` keeps. Masked pixels are zero in both images for the
    windows of SSIM, as are pixels beyond the border, and get no gradient. With nothing kept, or with
    weight 0, the loss and the gradient are exactly 0.

    Raises:
        InputError: when shapes or precision do not fit.
    """
    _check(image, target, mask)
    if gradient is None:
        gradient = torch.empty_like(image, memory_format=torch.contiguous_format, requires_grad=False)
    return backend_for(image.device).photometric_loss(
        image, target, ssim_lambda=ssim_lambda, weight=weight, mask=mask, gradient=gradient
    )


def psnr(image: Tensor, target: Tensor, mask: Tensor | None = None) -> float:
    """Peak signal-to-noise ratio in dB for a peak of 1; infinite when nothing differs."""
    _check(image, target, mask)
    return backend_for(image.device).psnr(image, target, mask)


def _check(image: Tensor, target: Tensor, mask: Tensor | None) -> None:
    if image.ndim != 3 or image.shape[2] != 3 or image.shape != target.shape:
        raise InputError(
            f"images of the shapes {tuple(image.shape)} and {tuple(target.shape)} cannot be compared",
            hint="both must be [H, W, 3]",
        )
    for tensor in (image, target):
        if tensor.dtype != torch.float32 or tensor.device != image.device:
            raise InputError(
                f"an image is {tensor.dtype} on {tensor.device}",
                hint="give float32 images, both on the CPU or both on one GPU",
            )
    if mask is not None and (mask.shape != image.shape[:2] or mask.dtype != torch.bool):
        raise InputError(
            f"the mask is {mask.dtype} with the shape {tuple(mask.shape)}",
            hint=f"give a bool mask of the shape {tuple(image.shape[:2])}",
        )
