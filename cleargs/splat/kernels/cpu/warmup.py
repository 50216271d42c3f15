"""Runs each kernel once on a tiny scene, so that compilation does not happen within what is timed."""

from __future__ import annotations

import numpy as np
import torch

from cleargs.splat.adam import adam_step
from cleargs.splat.camera import Camera
from cleargs.splat.gaussians import Gaussians
from cleargs.splat.kernels.cpu import affine_colour
from cleargs.splat.kernels.cpu.backend import add_position_noise
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


def run() -> None:
    """Every kernel, in the order of a training step; the backward pass with and without alpha and depth."""
    scene = _scene()
    camera = Camera(SIZE, SIZE, float(SIZE), float(SIZE), SIZE / 2, SIZE / 2, np.eye(4))
    rasteriser = CpuRasteriser()
    image = torch.zeros(SIZE, SIZE, 3)
    plane = torch.zeros(SIZE, SIZE)
    mask = torch.ones(SIZE, SIZE, dtype=torch.bool)
    affine = np.eye(3, 4, dtype=np.float32)
    pixels, sums = image.numpy(), np.empty((SIZE, 3, 4))
    row = torch.zeros(1, 3)
    for depth in (False, True):
        rasteriser.forward(
            scene, camera, sh_count=16, background=(0.0, 0.0, 0.0), antialias=False, depth=depth
        )
    rasteriser.backward(image, None, None)
    rasteriser.backward(image, plane, None)
    rasteriser.backward(image, plane, plane)
    for counted in (None, mask):
        photometric_loss(image, image, ssim_lambda=0.2, mask=counted)
        psnr(image, image, counted)
    adam_step(row, row.clone(), row.clone(), row.clone(), step=1, lr=0.0)
    add_position_noise(scene, amount=0.0, min_opacity=0.005, seed=(0,))
    affine_colour.apply_affine(pixels, affine, pixels.copy())
    affine_colour.affine_backward(pixels, affine, pixels, pixels.copy(), sums)
