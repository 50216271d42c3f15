"""One training iteration: forward pass, loss, backward pass, Adam."""

from __future__ import annotations

import torch
from torch import Tensor

from benchmarks.speed.probe import timed_kernels
from benchmarks.speed.random_scenes import random_image
from benchmarks.speed.timing import Clock
from cleargs.splat.backend import LossAccumulator, rasteriser_for, set_threads, step_gaussians
from cleargs.splat.camera import Camera
from cleargs.splat.gaussians import Gaussians
from cleargs.splat.kernels.cpu.pipeline import CpuForwardPass, CpuRasteriser
from cleargs.splat.types import Moments

PARTS = ("forward", "loss", "backward", "adam")
WHOLE = "iteration"

SSIM_LAMBDA = 0.2


def use_threads(count: int) -> None:
    """Kernels and torch run on ``count`` threads from now on."""
    set_threads(count)
    torch.set_num_threads(count)


class Iteration:
    """A scene, a target image and everything that training keeps from step to step.

    Adam's rate is 0: it does all its work, and the scene stays the one whose error is measured.
    """

    def __init__(self, gaussians: Gaussians, camera: Camera, device: torch.device | str = "cpu") -> None:
        self.gaussians = gaussians.to(device)
        self.camera = camera
        self.engine = rasteriser_for(device)
        self._target = random_image(camera.width, camera.height).to(device)
        self._slope = torch.empty_like(self._target)
        self._losses = LossAccumulator(device, SSIM_LAMBDA)
        self._moments = Moments.zeros(self.gaussians)
        self._rates: dict[str, float | Tensor] = dict.fromkeys(self.gaussians.tensors(), 0.0)
        self._step = 0

    def run(self, clock: Clock) -> None:
        """One iteration, a repetition on ``clock``: PARTS and WHOLE."""
        self._step += 1
        with clock.repetition(), clock.time(WHOLE):
            with clock.time("forward"):
                image = self.image()
            with clock.time("loss"):
                slope = self.differentiate(image)
            with clock.time("backward"):
                gradients = self.backward(slope)
            with clock.time("adam"):
                step_gaussians(self.gaussians, gradients, self._moments, self._rates, step=self._step)

    def image(self) -> Tensor:
        """What is compared with the target: [H, W, 3]."""
        return self.engine.forward(self.gaussians, self.camera).image

    def backward(self, slope: Tensor) -> Gaussians:
        """Gradients of the parameters for that of the loss by `image` [H, W, 3]."""
        return self.engine.backward(slope)

    def differentiate(self, image: Tensor) -> Tensor:
        """The gradient of the loss by the image [H, W, 3]."""
        self._losses.add(0, image, self._target, gradient=self._slope)
        self._losses.take()
        return self._slope

    def run_several(self, repetitions: int, clock: Clock) -> None:
        """Several iterations."""
        for _ in range(repetitions):
            self.run(clock)

    def run_on(self, threads: int, repetitions: int, clock: Clock) -> None:
        """Several iterations on so many threads, every kernel timed as well."""
        use_threads(threads)
        with timed_kernels(clock):
            self.run_several(repetitions, clock)

    def image_and_gradients(self, grad_image: Tensor) -> tuple[Tensor, Gaussians]:
        """Copies, on the CPU, of the rendered image [H, W, 3] and of the gradients for dL/d(image)
        [H, W, 3].
        """
        image = self.image().clone()
        gradients = self.backward(grad_image.to(image.device)).clone()
        return image.cpu(), gradients.to("cpu")


class _InspectableRasteriser(CpuRasteriser):
    """The CPU rasteriser with a view of what lies between its passes."""

    @property
    def frame(self) -> CpuForwardPass:
        frame: CpuForwardPass = self._state
        return frame


def projected_frame(gaussians: Gaussians, camera: Camera) -> CpuForwardPass:
    """Packed splats, (tile, splat) pairs and each pixel's last contributor of a view (SH degree 3)."""
    rasteriser = _InspectableRasteriser()
    rasteriser.forward(gaussians, camera)
    return rasteriser.frame
