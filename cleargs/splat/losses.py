"""Photometric loss with its gradient, SSIM and PSNR: fixed-order sums on every device.

The device of the images chooses the kernels.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from cleargs.errors import InputError
from cleargs.splat.kernels.cuda import support

_DEVICES = ("cpu", "cuda")


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

    Means run over the pixels that ``mask`` keeps. Masked pixels are zero in both images for the
    windows of SSIM, as are pixels beyond the border, and get no gradient. With nothing kept, or with
    weight 0, the loss and the gradient are exactly 0.

    Raises:
        InputError: when shapes or precision do not fit.
    """
    _check(image, target, mask)
    if gradient is None:
        gradient = torch.empty_like(image, memory_format=torch.contiguous_format, requires_grad=False)
    if support.on_gpu(image.device):
        return _loss_on_gpu(image, target, ssim_lambda, weight, mask, gradient)
    from cleargs.splat.kernels.cpu import launch, loss

    with launch.exclusive():
        padded = _pad(image, target, mask)
        l1, similarity, count, maps = _measure(padded)
        if weight == 0.0 or count == 0:
            gradient.zero_()
        else:
            loss.differentiate(
                padded.image,
                padded.target,
                padded.counted,
                loss.ssim_window(),
                maps,
                np.float32(weight * (1.0 - ssim_lambda) / count),
                np.float32(-weight * ssim_lambda / count),
                gradient.numpy(),
            )
    value = weight * ((1.0 - ssim_lambda) * l1 + ssim_lambda * (1.0 - similarity)) if count else 0.0
    return PhotometricLoss(value, gradient, l1, similarity)


def ssim(image: Tensor, target: Tensor, mask: Tensor | None = None) -> float:
    """Mean SSIM of two images [H, W, 3] in [0, 1] over the pixels that ``mask`` keeps (1 when none is).

    11 x 11 Gaussian window, sigma 1.5, zero padding, as in the Inria code.
    """
    _check(image, target, mask)
    if support.on_gpu(image.device):
        from cleargs.splat.kernels.cuda.loss import Photometer

        measured = Photometer()(image, target, mask, l1_weight=0.0, ssim_weight=0.0, gradient=None)
        return measured.read(ssim_lambda=0.0, weight=1.0).ssim
    from cleargs.splat.kernels.cpu import launch

    with launch.exclusive():
        _, similarity, _, _ = _measure(_pad(image, target, mask))
    return similarity


def psnr(image: Tensor, target: Tensor, mask: Tensor | None = None) -> float:
    """Peak signal-to-noise ratio in dB for a peak of 1; infinite when nothing differs."""
    _check(image, target, mask)
    if support.on_gpu(image.device):
        errors = (image.detach().double() - target.double()).square()
        errors = errors if mask is None else errors[mask]
        mean = float(errors.mean()) if errors.numel() else 0.0
        return -10.0 * math.log10(mean) if mean > 0.0 else math.inf
    from cleargs.splat.kernels.cpu import launch, loss

    row_sums = np.empty((image.shape[0], 2), np.float64)
    with launch.exclusive():
        loss.squared_errors(_read(image), _read(target), None if mask is None else _read(mask), row_sums)
    total, count = math.fsum(row_sums[:, 0]), math.fsum(row_sums[:, 1])
    return 10.0 * math.log10(count / total) if total > 0.0 else math.inf


def _loss_on_gpu(
    image: Tensor,
    target: Tensor,
    ssim_lambda: float,
    weight: float,
    mask: Tensor | None,
    gradient: Tensor,
) -> PhotometricLoss:
    from cleargs.splat.kernels.cuda.loss import Photometer

    measured = Photometer()(
        image,
        target,
        mask,
        l1_weight=weight * (1.0 - ssim_lambda),
        ssim_weight=-weight * ssim_lambda,
        gradient=gradient,
    )
    read = measured.read(ssim_lambda=ssim_lambda, weight=weight)
    return PhotometricLoss(read.loss, gradient, read.l1, read.ssim)


class _Padded(NamedTuple):
    image: npt.NDArray[np.float32]  # [H, padded length]
    target: npt.NDArray[np.float32]
    counted: npt.NDArray[np.float32]


def _read(tensor: Tensor) -> npt.NDArray[np.float32]:
    array: npt.NDArray[np.float32] = tensor.detach().contiguous().numpy()
    return array


def _check(image: Tensor, target: Tensor, mask: Tensor | None) -> None:
    if image.ndim != 3 or image.shape[2] != 3 or image.shape != target.shape:
        raise InputError(
            f"images of the shapes {tuple(image.shape)} and {tuple(target.shape)} cannot be compared",
            hint="both must be [H, W, 3]",
        )
    for tensor in (image, target):
        if (
            tensor.dtype != torch.float32
            or tensor.device != image.device
            or tensor.device.type not in _DEVICES
        ):
            raise InputError(
                f"an image is {tensor.dtype} on {tensor.device}",
                hint="give float32 images, both on the CPU or both on one GPU",
            )
    if mask is not None and (mask.shape != image.shape[:2] or mask.dtype != torch.bool):
        raise InputError(
            f"the mask is {mask.dtype} with the shape {tuple(mask.shape)}",
            hint=f"give a bool mask of the shape {tuple(image.shape[:2])}",
        )


def _pad(image: Tensor, target: Tensor, mask: Tensor | None) -> _Padded:
    from cleargs.splat.kernels.cpu import loss

    shape = (image.shape[0], loss.padded_length(image.shape[1]))
    padded = _Padded(*(np.empty(shape, np.float32) for _ in range(3)))
    loss.pad_images(_read(image), _read(target), None if mask is None else _read(mask), *padded)
    return padded


def _measure(padded: _Padded) -> tuple[float, float, float, npt.NDArray[np.float32]]:
    """Mean |x - y|, mean SSIM, the number of values that count, and the derivative maps of SSIM."""
    from cleargs.splat.kernels.cpu import loss

    # The kernels read maps between the padding only, so what is there need not be set.
    maps = np.empty((3, *padded.image.shape), np.float32)
    row_sums = np.empty((len(padded.image), 3), np.float64)
    loss.measure(*padded, loss.ssim_window(), maps, row_sums)
    l1, similarity, count = (math.fsum(column) for column in row_sums.T)
    if count == 0:
        return 0.0, 1.0, 0.0, maps
    return l1 / count, similarity / count, count, maps
