"""A training iteration to measure: forward pass, loss, backward pass and Adam."""

from __future__ import annotations

import torch
from torch import Tensor

from benchmarks.speed.probe import timed_kernels
from benchmarks.speed.random_scenes import random_image
from benchmarks.speed.timing import Clock
from cleargs.splat.backend import LossAccumulator, backend_for, set_threads
from cleargs.splat.camera import Camera
from cleargs.splat.gaussians import Gaussians
from cleargs.splat.kernels.cpu.pipeline import CpuForwardPass, CpuRasteriser
from cleargs.splat.types import Moments, Rates

PARTS = ("forward", "loss", "backward", "adam")
WHOLE = "iteration"

SSIM_LAMBDA = 0.2
"""Weight of D-SSIM in the loss, as in the Inria code."""


def use_threads(count: int) -> None:
    """Run kernels and torch on ``count`` threads from now on."""
    set_threads(count)
    torch.set_num_threads(count)


class Iteration:
    """A scene, a target image and the state of a training.

    Adam's learning rate is 0: Adam does all its work, but the scene does not change.
    """

    def __init__(self, gaussians: Gaussians, camera: Camera, device: torch.device | str = "cpu") -> None:
        self.gaussians = gaussians.to(device)
        self.camera = camera
        self._backend = backend_for(device)
        self.engine = self._backend.rasteriser(torch.device(device))
        self._target = random_image(camera.width, camera.height).to(device)
        self._gradient = torch.empty_like(self._target)
        self._losses = LossAccumulator(device, SSIM_LAMBDA)
        self._moments = Moments.zeros(self.gaussians)
        self._rates = Rates(*[0.0] * len(Rates._fields))
        self._step = 0

    def run(self, clock: Clock) -> None:
        """Run one iteration and time `PARTS` and `WHOLE` on ``clock``."""
        self._step += 1
        with clock.repetition(), clock.time(WHOLE):
            with clock.time("forward"):
                image = self.image()
            with clock.time("loss"):
                gradient = self.differentiate(image)
            with clock.time("backward"):
                gradients = self.backward(gradient)
            with clock.time("adam"):
                self._backend.step_gaussians(
                    *(self.gaussians, gradients, self._moments, self._rates),
                    step=self._step,
                    opacity=0.0,
                    scale=0.0,
                )

    def image(self) -> Tensor:
        """Return the image [H, W, 3] that is compared with the target."""
        return self.engine.forward(self.gaussians, self.camera).image

    def backward(self, gradient: Tensor) -> Gaussians:
        """Return the gradients of the parameters for ``gradient``, dL/d(image) [H, W, 3]."""
        return self.engine.backward(gradient)

    def differentiate(self, image: Tensor) -> Tensor:
        """Return dL/d(image) [H, W, 3]."""
        self._losses.add(0, image, self._target, gradient=self._gradient)
        self._losses.take()
        return self._gradient

    def run_several(self, repetitions: int, clock: Clock) -> None:
        """Run ``repetitions`` iterations."""
        for _ in range(repetitions):
            self.run(clock)

    def run_on(self, threads: int, repetitions: int, clock: Clock) -> None:
        """Run iterations on ``threads`` threads and time each kernel too."""
        use_threads(threads)
        with timed_kernels(clock):
            self.run_several(repetitions, clock)

    def image_and_gradients(self, grad_image: Tensor) -> tuple[Tensor, Gaussians]:
        """Return the image [H, W, 3] and the gradients for dL/d(image) [H, W, 3], as copies on the CPU."""
        image = self.image().clone()
        gradients = self.backward(grad_image.to(image.device)).clone()
        return image.cpu(), gradients.to("cpu")


class _InspectableRasteriser(CpuRasteriser):
    """The CPU rasteriser with access to the state between its passes."""

    @property
    def frame(self) -> CpuForwardPass:
        frame: CpuForwardPass = self._state
        return frame


def projected_frame(gaussians: Gaussians, camera: Camera) -> CpuForwardPass:
    """Return a view's packed splats, (tile, splat) pairs and last contributor per pixel (SH degree 3)."""
    rasteriser = _InspectableRasteriser()
    rasteriser.forward(gaussians, camera)
    return rasteriser.frame
