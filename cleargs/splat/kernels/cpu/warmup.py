"""Runs each kernel once on a tiny scene, so that compilation does not happen within what is timed."""

from __future__ import annotations

import numpy as np
import torch

from cleargs.splat.adam import adam_step
from cleargs.splat.camera import Camera
from cleargs.splat.gaussians import Gaussians
from cleargs.splat.kernels.cpu import affine_colour, backend, frame_warp
from cleargs.splat.kernels.cpu.backend import add_position_noise
from cleargs.splat.kernels.cpu.pipeline import CpuRasteriser
from cleargs.splat.kernels.warp_layout import CHANNELS, CURVE_STEPS, MOTION_COLUMNS
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
    """Every kernel with the types that a training has, in the order of its steps; the backward pass with and
    without alpha and depth."""
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
    _photograph()


def _photograph() -> None:
    """What a moving camera makes of an image, and the search for its motion."""
    plane, colours = torch.ones(SIZE, SIZE), torch.zeros(SIZE, SIZE, CHANNELS)
    curve, still = torch.zeros(CURVE_STEPS + 1), torch.ones(MOTION_COLUMNS)
    _, slope = backend.through_curve(colours, curve, CHANNELS)
    backend.times_slope(colours, slope, CHANNELS)
    fields = backend.displacements(plane, plane, still, margin=0)
    light = backend.expose(colours, fields, torch.zeros(1, 3), margin=0)
    backend.expose_backward(light, fields, torch.zeros(1, 3), margin=0)
    pixels, rows = plane.numpy(), np.empty(SIZE)
    offset, sweep, radius = (field.numpy() for field in fields[:3])
    frame_warp.misfits(pixels, pixels, pixels, offset, sweep, radius, np.zeros((1, 3), np.float32), 1.0, rows)
    frame_warp.normal_equations(
        np.zeros((SIZE, SIZE, 3), np.float32),
        pixels,
        pixels,
        np.zeros((6, 2, SIZE, SIZE), np.float32),
        np.zeros(SIZE, np.float32),
        offset,
        sweep,
        np.zeros(1, np.float32),
        1.0,
        np.arange(6),
        np.empty((SIZE, 6, 6)),
        np.empty((SIZE, 6)),
    )
