"""Bitwise equality across thread counts and runs."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

PROGRAM = """
import hashlib, sys
import torch
from helpers.splat_scenes import make_camera, make_gaussians
from cleargs.splat.backend import psnr, rasteriser_for
from helpers.losses import adam_step, photometric_loss
from cleargs.splat.backend import backend_for
from cleargs.splat.backend import set_threads
from cleargs.splat.types import Moments

def digest(threads):
    set_threads(threads)
    result = hashlib.sha256()
    camera = make_camera(150, 101)
    scene = make_gaussians(camera, 1500, size_px=3.0)
    scene.means[:300, 2] = scene.means[0, 2]
    target = torch.rand(101, 150, 3, generator=torch.Generator().manual_seed(1))
    mask = target[..., 0] > 0.2
    engine = rasteriser_for()
    moments = Moments.zeros(scene)
    for step in range(1, 4):
        view = engine.forward(scene, camera, depth=True, antialias=step == 2)
        loss = photometric_loss(view.image, target, ssim_lambda=0.2, mask=mask)
        gradients = engine.backward(loss.grad_image, view.alpha, view.depth)
        _, affine = backend_for("cpu").affine_backward(view.image, torch.eye(3, 4), loss.grad_image)
        for tensor in (*view, loss.grad_image, affine, engine.visible, *gradients.tensors().values()):
            result.update(tensor.numpy().tobytes())
        result.update(repr((loss.loss, loss.l1, loss.ssim, psnr(view.image, target))).encode())
        adam_step(scene, gradients, moments, step)
    for tensor in scene.tensors().values():
        assert tensor.isfinite().all()
        result.update(tensor.numpy().tobytes())
    return result.hexdigest()

print(*(digest(threads) for threads in (1, 2, 16, 16)))
"""


def run() -> list[str]:
    here = Path(__file__).parents[1]
    environment = os.environ | {"NUMBA_NUM_THREADS": "16", "PYTHONPATH": str(here)}
    result = subprocess.run(
        [sys.executable, "-c", PROGRAM], env=environment, capture_output=True, text=True, check=False
    )
    assert result.returncode == 0, result.stderr
    return result.stdout.split()


def test_training_is_bitwise_equal_across_threads_and_runs():
    digests = [*run(), *run()]
    assert len(digests) == 8
    assert len(set(digests)) == 1


NEEDLES = """
import hashlib, torch
from helpers.splat_scenes import make_camera, make_gaussians, make_needles
from cleargs.splat.kernels.cpu.backend import add_position_noise, rasteriser

camera, engine, result = make_camera(), rasteriser(torch.device("cpu")), hashlib.sha256()
sizes = [(n, 10.0**power) for n in range(60, 70) for power in (4, 6, 8)]
needles = [make_needles(camera, n, length_px=length, aspect=1e5) for n, length in sizes]
for gaussians in (make_gaussians(camera, 200), *needles):
    image = engine.forward(gaussians, camera).image
    result.update(image.numpy().tobytes())
    slope = torch.sin(torch.arange(image.numel())).view(image.shape)
    for gradient in engine.backward(slope).tensors().values():
        result.update(gradient.numpy().tobytes())
    add_position_noise(gaussians, amount=1.0, min_opacity=0.5, seed=(0,))
    result.update(gaussians.means.numpy().tobytes())
print(result.hexdigest())
"""


@pytest.mark.slow
def test_compiled_and_cached_kernels_round_alike(tmp_path: Path):
    here = Path(__file__).parent
    paths = f"{here}{os.pathsep}{here.parent}"
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path), "PYTHONPATH": paths}
    compiled, loaded = (
        subprocess.run(
            [sys.executable, "-c", NEEDLES], env=environment, capture_output=True, text=True, check=True
        ).stdout
        for _ in range(2)
    )
    assert compiled == loaded
