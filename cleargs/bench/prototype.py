"""A predecessor's training iteration, where its folder is given: timed and checked like ours.

The folder holds ``train.py`` with ``main(threads, iters)``, which leaves its times in ``TM``, and the pieces
``proj`` and ``Raster`` that it is made of, for N splats at W x H.
"""

from __future__ import annotations

import contextlib
import importlib
import io
import sys
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from cleargs.bench.iteration import WHOLE
from cleargs.bench.timing import Clock
from cleargs.errors import InputError
from cleargs.splat.camera import Camera
from cleargs.splat.gaussians import Gaussians

WARM_UP = 5
"""Iterations that ``main`` does not count."""


class Prototype:
    """The trainer in a folder.

    Raises:
        InputError: when there is none.
    """

    def __init__(self, folder: Path) -> None:
        if not (folder / "train.py").is_file():
            raise InputError(f"{folder} holds no train.py", hint="name the folder of the prototype")
        sys.path.insert(0, str(folder))
        try:
            self._train: Any = importlib.import_module("train")
        finally:
            sys.path.remove(str(folder))

    @property
    def size(self) -> tuple[int, int, int]:
        """Gaussians, width and height that it is written for."""
        return self._train.N, self._train.W, self._train.H

    def run_on(self, threads: int, repetitions: int, clock: Clock) -> None:
        """Several iterations on so many threads, each a repetition on ``clock``."""
        with contextlib.redirect_stdout(io.StringIO()):
            self._train.main(threads, iters=WARM_UP + repetitions)
        for seconds in self._train.TM["TOTAL"]:
            with clock.repetition():
                clock.add(WHOLE, 1e3 * seconds)

    def image_and_gradients(
        self, gaussians: Gaussians, camera: Camera, grad_image: Tensor
    ) -> tuple[Tensor, Gaussians]:
        """Image [H, W, 3] and gradients for dL/d(image), by its own projection and rasteriser.

        The view must have the prototype's size.
        """
        leaves = [tensor.detach().clone().requires_grad_() for tensor in gaussians.tensors().values()]
        means, log_scales, rotations, logits, sh = leaves
        view = torch.from_numpy(camera.world_to_camera.astype(np.float32))
        intrinsics = [camera.fx, camera.fy, camera.cx, camera.cy]
        centres, conics, colours, depths = self._train.proj(
            means, log_scales.exp(), rotations, sh, view, intrinsics
        )
        image, _ = self._train.Raster.apply(
            centres, conics, colours, torch.sigmoid(logits), depths.detach(), torch.zeros(3)
        )
        gradients = torch.autograd.grad((image * grad_image).sum(), leaves)
        return image.detach(), Gaussians(*gradients)
