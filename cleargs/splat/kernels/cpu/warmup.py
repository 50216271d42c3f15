"""Runs each kernel once on a tiny scene, so that compilation happens where progress can be shown."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
import torch

from cleargs.splat.adam import adam_step
from cleargs.splat.camera import Camera
from cleargs.splat.gaussians import Gaussians
from cleargs.splat.kernels.cpu import affine_colour
from cleargs.splat.kernels.cpu.pipeline import CpuRasteriser
from cleargs.splat.losses import photometric_loss, psnr

SIZE = 16


def _scene() -> Gaussians:
    """One grey Gaussian in front of the camera."""
    return Gaussians(
        means=torch.tensor([[0.0, 0.0, 2.0]]),
        log_scales=torch.full((1, 3), -2.0),
        rotations=torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
        logit_opacities=torch.zeros(1),
        sh=torch.zeros(1, 16, 3),
    )


def steps() -> list[tuple[str, Callable[[], object]]]:
    """(name, call) of every kernel, in the order of a training step."""
    scene = _scene()
    camera = Camera(SIZE, SIZE, float(SIZE), float(SIZE), SIZE / 2, SIZE / 2, np.eye(4))
    rasteriser = CpuRasteriser()
    image = torch.zeros(SIZE, SIZE, 3)
    plane = torch.zeros(SIZE, SIZE)
    mask = torch.ones(SIZE, SIZE, dtype=torch.bool)
    affine = np.eye(3, 4, dtype=np.float32)
    pixels, sums = image.numpy(), np.empty((SIZE, 3, 4))
    row = torch.zeros(1, 3)

    def forward(depth: bool) -> object:
        return rasteriser.forward(
            scene, camera, sh_count=16, background=(0.0, 0.0, 0.0), antialias=False, depth=depth
        )

    return [
        ("projection, binning and forward pass", partial(forward, False)),
        ("forward pass with depth", partial(forward, True)),
        ("backward pass", lambda: rasteriser.backward(image, None, None)),
        ("backward pass with alpha", lambda: rasteriser.backward(image, plane, None)),
        ("backward pass with alpha and depth", lambda: rasteriser.backward(image, plane, plane)),
        ("loss", lambda: photometric_loss(image, image, ssim_lambda=0.2)),
        ("loss with mask", lambda: photometric_loss(image, image, ssim_lambda=0.2, mask=mask)),
        ("PSNR", lambda: psnr(image, image)),
        ("PSNR with mask", lambda: psnr(image, image, mask)),
        ("Adam", lambda: adam_step(row, row.clone(), row.clone(), row.clone(), step=1, lr=0.0)),
        ("exposure", lambda: affine_colour.apply_affine(pixels, affine, pixels.copy())),
        (
            "exposure backward",
            lambda: affine_colour.affine_backward(pixels, affine, pixels, pixels.copy(), sums),
        ),
    ]
