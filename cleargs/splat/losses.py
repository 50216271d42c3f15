"""Photometric loss with its gradient, and PSNR: fixed-order sums on every device.

The device of the images chooses the kernels.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from cleargs.errors import InputError
from cleargs.splat.backend import backend_for


class PhotometricLoss(NamedTuple):
    """weight * ((1 - lambda) l1 + lambda (1 - ssim)) and its gradient; l1 and ssim are unweighted means."""

    loss: float
    grad_image: Tensor  # [H, W, 3]
    l1: float
    ssim: float


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
