"""`cleargs.splat.backend.Backend` for NVIDIA GPUs: Triton kernels behind functions of tensors.

`Backend` documents the functions.
"""

from __future__ import annotations

import torch
from torch import Tensor

from cleargs.splat.kernels.cuda import support
from cleargs.splat.kernels.cuda.densify import add_position_noise as add_position_noise
from cleargs.splat.kernels.cuda.densify import refine as refine
from cleargs.splat.kernels.cuda.elementwise import affine_backward as affine_backward
from cleargs.splat.kernels.cuda.elementwise import apply_affine as apply_affine
from cleargs.splat.kernels.cuda.elementwise import step_gaussians as step_gaussians
from cleargs.splat.kernels.cuda.frame_warp import displacements as displacements
from cleargs.splat.kernels.cuda.frame_warp import expose as expose
from cleargs.splat.kernels.cuda.frame_warp import expose_backward as expose_backward
from cleargs.splat.kernels.cuda.frame_warp import through_curve as through_curve
from cleargs.splat.kernels.cuda.frame_warp import times_slope as times_slope
from cleargs.splat.kernels.cuda.loss import loss_sums as loss_sums
from cleargs.splat.kernels.cuda.pipeline import CudaRasteriser


def rasteriser(device: torch.device) -> CudaRasteriser:
    """Return a rasteriser. Raises InputError if the kernels cannot run on ``device``."""
    support.require(device)
    return CudaRasteriser(device)


def warm_up() -> None:
    """Do nothing: Triton compiles a kernel for the types and sizes of its first call."""


def squared_errors(image: Tensor, target: Tensor, mask: Tensor | None) -> tuple[float, float]:
    errors = (image.detach().double() - target.double()).square()
    errors = errors if mask is None else errors[mask]
    return float(errors.sum()), float(errors.numel())
