"""The loss of a single image, and a single step of Adam."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from cleargs.splat.backend import LossAccumulator, backend_for
from cleargs.splat.gaussians import Gaussians
from cleargs.splat.types import Moments, Rates


class PhotometricLoss(NamedTuple):
    """The value and the parts of a loss, and its gradient."""

    loss: float
    grad_image: Tensor  # [H, W, 3]
    l1: float
    ssim: float


def photometric_loss(
    image: Tensor,
    target: Tensor,
    *,
    ssim_lambda: float,
    weight: float = 1.0,
    mask: Tensor | None = None,
    saturated: float = math.inf,
) -> PhotometricLoss:
    """Return the result of `LossAccumulator` for one image."""
    gradient = torch.full(image.shape, 7.0, device=image.device)
    losses = LossAccumulator(image.device, ssim_lambda, saturated=saturated)
    losses.add(0, image, target, mask, weight=weight, gradient=gradient)
    ((_, read),) = losses.take()
    return PhotometricLoss(read.loss, gradient, read.l1, read.ssim)


def adam_step(
    gaussians: Gaussians, gradients: Gaussians, moments: Moments, step: int, rate: float | Rates = 0.01
) -> None:
    """Do a step of Adam in place, without regularisation, with one rate or those of each parameter."""
    rates = rate if isinstance(rate, Rates) else Rates(*[rate] * len(Rates._fields))
    backend_for(gaussians.device).step_gaussians(
        gaussians, gradients, moments, rates, step=step, opacity=0.0, scale=0.0
    )
