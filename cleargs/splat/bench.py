"""Timing of a training iteration, stage by stage, on random splats."""

from __future__ import annotations

import contextlib
import importlib
import io
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from statistics import median

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from cleargs.errors import InputError
from cleargs.splat.adam import adam_step
from cleargs.splat.camera import Camera
from cleargs.splat.engine import Engine
from cleargs.splat.gaussians import Gaussians
from cleargs.splat.losses import photometric_loss

WARM_UP = 5
"""Iterations that are not counted."""
MEDIAN_SIGMA = 1.8
"""Median standard deviation of the projected splats, px: about six tiles a splat with its tails."""


def random_scene(count: int, width: int, height: int, seed: int = 0) -> tuple[Gaussians, Camera]:
    """``count`` splats of about `MEDIAN_SIGMA` px, evenly over the view of a camera at the origin."""
    rng = np.random.default_rng(seed)
    focal = 0.87 * width
    z = rng.uniform(2.0, 10.0, count)
    u, v = (side * rng.uniform(-0.03, 1.03, count) for side in (width, height))
    means = np.stack([(u - width / 2) / focal * z, (v - height / 2) / focal * z, z], 1)
    sigma = MEDIAN_SIGMA * np.exp(rng.normal(0, 0.5, count)) * z / focal
    scales = sigma[:, None] * np.exp(rng.normal(0, 0.5, (count, 3)))
    opacities = rng.uniform(0.05, 0.95, count)
    sh = rng.normal(0, 0.15, (count, 16, 3))
    sh[:, 0] = rng.normal(0, 1, (count, 3))

    def tensor(array: NDArray[np.float64]) -> Tensor:
        return torch.from_numpy(np.ascontiguousarray(array, np.float32))

    gaussians = Gaussians(
        tensor(means),
        tensor(np.log(scales)),
        tensor(rng.normal(size=(count, 4))),
        tensor(np.log(opacities / (1 - opacities))),
        tensor(sh),
    )
    return gaussians, Camera(width, height, focal, focal, width / 2, height / 2, np.eye(4))


class _Clock:
    """Seconds of each part of an iteration."""

    def __init__(self) -> None:
        self.parts: dict[str, list[float]] = {}

    @contextlib.contextmanager
    def time(self, part: str) -> Iterator[None]:
        start = time.perf_counter()
        yield
        self.parts.setdefault(part, []).append(time.perf_counter() - start)


def time_iteration(count: int, width: int, height: int, iterations: int = 20) -> dict[str, float]:
    """Median milliseconds of forward, loss, backward, Adam and of the whole iteration (SH degree 3)."""
    gaussians, camera = random_scene(count, width, height)
    target = torch.from_numpy(np.random.default_rng(1).uniform(size=(height, width, 3)).astype(np.float32))
    first = {name: torch.zeros_like(value) for name, value in gaussians.tensors().items()}
    second = {name: torch.zeros_like(value) for name, value in gaussians.tensors().items()}
    engine, slope = Engine(), torch.empty(height, width, 3)
    clock = _Clock()
    for step in range(1, WARM_UP + iterations + 1):
        if step == WARM_UP + 1:
            clock.parts.clear()
        with clock.time("iteration"):
            with clock.time("forward"):
                render = engine.forward(gaussians, camera)
            with clock.time("loss"):
                loss = photometric_loss(render.image, target, ssim_lambda=0.2, gradient=slope)
            with clock.time("backward"):
                gradients = engine.backward(loss.grad_image).tensors()
            with clock.time("adam"):
                for name, value in gaussians.tensors().items():
                    adam_step(value, gradients[name], first[name], second[name], step=step, lr=1e-3)
    return {part: 1e3 * median(seconds) for part, seconds in clock.parts.items()}


def time_prototype(folder: Path, threads: int) -> float:
    """Median milliseconds of one iteration of the prototype in ``folder`` (50,000 splats, 640x360).

    Raises InputError when ``folder`` does not hold it.
    """
    if not (folder / "train.py").is_file():
        raise InputError(f"{folder} holds no train.py", hint="name the folder of the prototype")
    sys.path.insert(0, str(folder))
    try:
        prototype = importlib.import_module("train")
        with contextlib.redirect_stdout(io.StringIO()):
            prototype.main(threads)
    finally:
        sys.path.remove(str(folder))
    return 1e3 * float(median(prototype.TM["TOTAL"]))
