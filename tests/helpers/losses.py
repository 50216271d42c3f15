"""The loss of a single image, and a single step of Adam."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from cleargs.splat.backend import LossAccumulator, backend_for
from cleargs.splat.types import Rate


class PhotometricLoss(NamedTuple):
    """The value and the parts of a loss, and its gradient."""

    loss: float
    grad_image: Tensor  # [H, W, 3]
    l1: float
    ssim: float


def photometric_loss(
    image: Tensor, target: Tensor, *, ssim_lambda: float, weight: float = 1.0, mask: Tensor | None = None
) -> PhotometricLoss:
    """Return the result of `LossAccumulator` for one image."""
    gradient = torch.full(image.shape, 7.0, device=image.device)
    losses = LossAccumulator(image.device, ssim_lambda)
    losses.add(0, image, target, mask, weight=weight, gradient=gradient)
    ((_, read),) = losses.take()
    return PhotometricLoss(read.loss, gradient, read.l1, read.ssim)


def adam_step(
    parameter: Tensor, gradient: Tensor, first: Tensor, second: Tensor, step: int, rate: Rate
) -> None:
    """Do a step of Adam in place."""
    backend_for(parameter.device).adam_step(parameter, gradient, first, second, step, rate)
