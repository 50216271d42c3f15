"""Compare the GPU's kernels with the CPU's on this machine.

``cleargs.gpu`` runs this module in a child process and reads its lines of JSON from stdout. Every check runs
twice on the GPU, which must give the same bits, and once on the CPU, with the tolerances of ``tests/gpu``.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from cleargs.splat.backend import Backend
from cleargs.splat.camera import Camera, Readout
from cleargs.splat.gaussians import Gaussians
from cleargs.splat.kernels import warp_layout
from cleargs.splat.kernels.cuda.support import gpu_fault
from cleargs.splat.random_scene import random_scene
from cleargs.splat.types import Moments, Rates


class View(NamedTuple):
    """A random scene: number of Gaussians, image size in px, median deviation of a Gaussian in px."""

    gaussians: int
    width: int
    height: int
    sigma: float = 1.8
    faint: bool = False
    """True: opacities near 0.02, so that a ray passes hundreds of Gaussians."""
    all_outputs: bool = False
    """True: with anti-aliasing, depth, gradients of alpha and depth, and SH of degree 1 instead of 3."""
    rolls: bool = False
    """True: the shutter of the camera rolls, with a skew of a tenth of the height."""

    def scene(self, device: torch.device) -> tuple[Gaussians, Camera]:
        """Return the Gaussians on ``device``, and the camera."""
        gaussians, camera = random_scene(self.gaussians, self.width, self.height, sigma=self.sigma)
        if self.faint:
            gaussians.logit_opacities -= gaussians.logit_opacities.mean() + 4.0
        if self.rolls:
            skew = 0.1 * camera.height / camera.fx
            twists = skew * np.array([[0.0] * 6, [0.5, -0.3, 0.2, 0.6, 0.8, 0.5], [0.1] * 6])
            readout = Readout(twists, camera.fy / camera.height, camera.cy / camera.height - 0.5)
            camera = replace(camera, readout=readout)
        return gaussians.to(device), camera


class Sizes(NamedTuple):
    """Sizes of the checks. Tests in Triton's interpreter use smaller ones."""

    views: dict[str, View]
    image: tuple[int, int] = (723, 1283)
    """Height and width of the images of loss and warp, px."""
    refined: int = 20_000
    """Gaussians of the refinement and of the noise."""
    timed: View = View(50_000, 640, 360)
    repeats: int = 20
    """Training steps that are timed."""


FULL = Sizes(
    {
        "rendering a small view": View(300, 61, 47, 4.0, all_outputs=True),
        "rendering with a rolling shutter": View(3_000, 160, 120, 3.0, rolls=True),
        "rendering long tile lists": View(4_000, 48, 32, 8.0, faint=True),
        # The numbers of 33,124 tiles do not fit in 16 bits. 200,000 Gaussians fill many blocks.
        "rendering a large view": View(200_000, 2912, 2912, 3.0),
    }
)

Rule = Callable[[Tensor, Tensor], str | None]
"""Function of a result and the CPU's result that returns a description of the fault, or None."""
Results = dict[str, tuple[Tensor, Rule]]
Run = Callable[[Backend, torch.device], Results]


def within(limit: float, *, relative: bool = False) -> Rule:
    """Return a rule: no value differs by more than ``limit``, or ``limit`` times the largest value."""

    def rule(found: Tensor, expected: Tensor) -> str | None:
        error = float((found.double() - expected.double()).abs().max())
        allowed = limit * (float(expected.double().abs().max()) if relative else 1.0)
        return None if error <= allowed else f"differs by {error:.2g}, more than {allowed:.2g}"

    return rule


def as_image(found: Tensor, expected: Tensor) -> str | None:
    """Compare images [H, W, ...]. A few pixels may differ, since rounding can move an alpha across 1/255."""
    apart = (found - expected).abs().reshape(*found.shape[:2], -1).amax(dim=2)
    share, most = float((apart > 1e-5).double().mean()), float(apart.max())
    return (
        f"differs in {share:.2%} of the pixels, by up to {most:.2g}" if share > 1e-3 or most > 0.05 else None
    )


def as_gradient(found: Tensor, expected: Tensor) -> str | None:
    """Compare gradients: the norm of the difference is at most 1e-3 of their norm."""
    error = float((found - expected).double().norm() / expected.double().norm().clamp(min=1e-30))
    return f"differs by {error:.2g} of its norm" if error > 1e-3 else None


def as_sample(found: Tensor, expected: Tensor) -> str | None:
    """Compare random draws by their standard deviation: the back ends draw different numbers."""
    ratio = float(found.double().std() / expected.double().std())
    return f"has {ratio:.2g} times the standard deviation" if abs(ratio - 1.0) > 0.1 else None


def _random(*shape: int, device: torch.device) -> Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(0)).to(device)


def render(view: View, backend: Backend, device: torch.device) -> Results:
    """Run a forward and a backward pass."""
    gaussians, camera = view.scene(device)
    engine = backend.rasteriser(device)
    degree = 1 if view.all_outputs else None
    shown = engine.forward(
        gaussians, camera, sh_degree=degree, antialias=view.all_outputs, depth=view.all_outputs
    )
    results: Results = {name: (getattr(shown, name).clone(), as_image) for name in ("image", "alpha")}
    if shown.depth is not None:
        results["depth"] = (shown.depth / 10.0, as_image)  # the scene ends at a depth of 10
    results["visibility"] = (engine.visible.clone(), within(0.0))
    slope = _random(view.height, view.width, 5, device=device) - 0.5
    further = (slope[..., 3], slope[..., 4]) if view.all_outputs else ()
    for name, gradient in engine.backward(slope[..., :3], *further).tensors().items():
        results[f"gradient of {name}"] = (gradient.clone(), as_gradient)
    return results


def loss(size: tuple[int, int], backend: Backend, device: torch.device) -> Results:
    """Compute L1 and D-SSIM with and without a mask, the squared error, and a colour affine.

    Targets from 0.9 are saturated.
    """
    images = _random(*size, 6, device=device)
    image, target = images[..., :3].contiguous(), images[..., 3:].contiguous()
    close, results = within(1e-5, relative=True), Results()
    for name, mask in (("", None), (" with a mask", images[..., 0] > 0.3)):
        slope = torch.empty_like(image)
        weights = {"l1_weight": 0.8, "ssim_weight": -0.2, "saturated": 0.9}
        sums = backend.loss_sums(image, target, mask, **weights, gradient=slope)
        squared = torch.tensor(backend.squared_errors(image, target, mask), dtype=torch.float64)
        results |= {f"loss{name}": (sums, close), f"gradient of the loss{name}": (slope, close)}
        results[f"squared error{name}"] = (squared, close)
    affine = torch.eye(3, 4) + 0.1 * _random(3, 4, device=torch.device("cpu"))
    by_image, by_affine = backend.affine_backward(image, affine, target)
    results["colour affine"] = (backend.apply_affine(image, affine), close)
    return results | {"its gradient": (by_image, close), "its parameters' gradient": (by_affine, close)}


def adam(view: View, backend: Backend, device: torch.device) -> Results:
    """Run three steps of Adam on regularised gradients."""
    gaussians, _ = view.scene(device)
    moments, gradients = Moments.zeros(gaussians), gaussians.clone()
    rates = Rates(0.1, 0.2, 0.15, 0.1, 0.1, 0.05)
    for step in (1, 2, 3):
        backend.step_gaussians(
            gaussians, gradients.clone(), moments, rates, step=step, opacity=0.01, scale=0.01
        )
    # 1 - 0.999 has a relative error of 1e-5 where 0.999 is rounded to float32.
    tensors = {**gaussians.tensors(), **moments.state()}
    return {name: (tensor, within(1e-4, relative=True)) for name, tensor in tensors.items()}


def warp(size: tuple[int, int], backend: Backend, device: torch.device) -> Results:
    """Apply motion blur, rolling shutter and defocus to an image, forward and backward."""
    (height, width), margin = size, 8
    seen = _random(height + 2 * margin, width + 2 * margin, 5, device=device)
    image, depth = seen[..., :4].contiguous(), 2.0 + seen[..., 4]
    camera = [width, width, width / 2, height / 2, 2.5, 3.0, 1.4]  # fx fy cx cy, median depth, disc, focus
    readout = [0.25, 1.0]  # across and down
    twists = [0, 1, 0, -2, 1, 0, 2, 1, -1, 4, 9, 2, 1, 0, 2, 3, 5, -2]  # pose, blur, skew
    curves = [0, 1, 0, 2, -3, 1, 1, 0, 1, -6, 3, 2, 0, 2, 0, 20, 9, 1]  # skew's bend, bend, cube
    motion = torch.tensor([*camera, *readout, *twists, *curves], dtype=torch.float32)
    fields = backend.displacements(depth, torch.ones_like(depth), motion, margin=margin)
    times = torch.linspace(-0.5, 0.5, 7)
    samples = torch.stack([times, times.flip(0), (3.0 * times).sin()], dim=1).to(device)
    curve = torch.linspace(0.0, 1.0, warp_layout.CURVE_STEPS + 1).square().to(device)
    linear, slope = backend.through_curve(image, curve, 4)
    assert fields.curve is not None
    exposed = backend.expose(image, fields, samples, margin=margin)
    still = backend.expose(image, fields, samples[3:4], margin=margin)  # by cubic interpolation
    returned = backend.expose_backward(exposed, fields, samples, margin=margin)
    # A position of up to 1,283 px in float32 has an error of 1e-4 px; a hundred pixels add to one sum.
    return {
        "offset": (fields.offset, within(1e-4)),
        "sweep": (fields.sweep, within(1e-4)),
        "curve": (fields.curve, within(1e-4)),
        "discs": (fields.radius, within(1e-4)),
        "exposed image": (exposed[..., :3], within(6e-4)),
        "image of one sample": (still[..., :3], within(6e-4)),
        "transpose": (returned[..., :3], within(2e-3)),
        "colour curve": (linear[..., :3], within(1e-6)),
        "slope": (slope, within(1e-4)),
        "product with the slope": (backend.times_slope(image, slope, 4)[..., :3], within(1e-4)),
    }


def refinement(count: int, backend: Backend, device: torch.device) -> Results:
    """Run a refinement without draws, one with draws, and the noise on the means."""
    results = Results()
    for number, drawn in ((40, False), (count, True)):
        gaussians, _ = View(number, 64, 48).scene(device)
        gaussians.logit_opacities[:] = torch.linspace(-8.0, 3.0, number).to(device)
        errors = torch.linspace(0.0, 1.0, number).to(device)
        if not drawn:  # There is room to split both of these Gaussians, so draws do not matter.
            errors[:] = 0.0
            errors[[20, 33]] = 2.0
        grown, _ = backend.refine(
            gaussians,
            Moments.zeros(gaussians),
            errors=errors,
            rate=0.5,
            budget=number + number * 17 // 40,
            min_opacity=0.01,
            seed=(1,),
        )
        if drawn:
            results["means after draws"] = (grown.means, as_sample)
        else:
            order = grown.means.double().sum(dim=1).sort(stable=True).indices
            results |= {name: (tensor[order], within(1e-4)) for name, tensor in grown.tensors().items()}
    crowd = View(1, 64, 48).scene(device)[0].select(torch.zeros(count, dtype=torch.int64, device=device))
    crowd.logit_opacities[:] = -9.0
    crowd.logit_opacities[: count // 2] = 2.0
    before = crowd.means.clone()
    backend.add_position_noise(crowd, amount=2.0, min_opacity=0.005, seed=(11,))
    results["opaque Gaussians after noise"] = (crowd.means[: count // 2], within(0.0))
    return results | {"noise": ((crowd.means - before)[count // 2 :], as_sample)}


def checks(sizes: Sizes) -> dict[str, Run]:
    """Return the checks by name, in the order in which they run."""
    return {
        **{name: partial(render, view) for name, view in sizes.views.items()},
        "loss and colour": partial(loss, sizes.image),
        "Adam": partial(adam, sizes.timed),
        "motion blur and defocus": partial(warp, sizes.image),
        "refinement": partial(refinement, sizes.refined),
    }


def faults(run: Run, gpu: Backend, cpu: Backend, device: torch.device) -> Iterator[str]:
    """Yield what is wrong with the results of a check on the GPU."""
    first, second = ({name: found.cpu() for name, (found, _) in run(gpu, device).items()} for _ in range(2))
    for name, (expected, rule) in run(cpu, torch.device("cpu")).items():
        found = first[name]
        if found.shape != expected.shape:
            yield f"{name}: has the shape {tuple(found.shape)}, on the CPU {tuple(expected.shape)}"
        elif not found.isfinite().all():
            yield f"{name}: has values that are not finite"
        elif wrong := rule(found, expected):
            yield f"{name}: {wrong}"
        elif not torch.equal(found, second[name]):
            yield f"{name}: has different bits in two runs on the GPU"


def iterate(view: View, repeats: int, backend: Backend, device: torch.device) -> tuple[float, int]:
    """Return the milliseconds of the fastest training step after three, and the growth of memory in bytes."""
    gaussians, camera = view.scene(device)
    target = _random(view.height, view.width, 3, device=device)
    slope, moments, engine = torch.empty_like(target), Moments.zeros(gaussians), backend.rasteriser(device)
    weights = {"l1_weight": 0.8, "ssim_weight": -0.2, "saturated": 1.0}
    rates = Rates(*[0.0] * len(Rates._fields))
    times, held = [], 0
    for step in range(1, repeats + 4):
        start = time.perf_counter()
        image = engine.forward(gaussians, camera).image
        backend.loss_sums(image, target, None, **weights, gradient=slope)
        gradients = engine.backward(slope)
        backend.step_gaussians(gaussians, gradients, moments, rates, step=step, opacity=0.0, scale=0.0)
        float(gaussians.means[0, 0])  # waits for the device
        times.append(1e3 * (time.perf_counter() - start))
        held = torch.cuda.memory_allocated() if step <= 3 else held
    return min(times[3:]), torch.cuda.memory_allocated() - held


def main(device: str = "cuda", sizes: Sizes = FULL) -> None:
    """Run all checks; print a line before and after each. An exception ends the test: the GPU may be dead."""

    def say(**facts: Any) -> None:
        print(json.dumps(facts), flush=True)

    say(starts="the start of CUDA")
    started = False
    try:
        if device == "cuda":
            torch.cuda.init()
        started = True
        from cleargs.splat.kernels.cpu import backend as cpu
        from cleargs.splat.kernels.cuda import backend as gpu

        on, start = torch.device(device), time.perf_counter()
        for name, run in checks(sizes).items():
            say(starts=name)
            found = list(faults(run, gpu, cpu, on))
            say(check=name, faults=found, seconds=time.perf_counter() - start)
            start = time.perf_counter()
        say(starts="memory")
        gpu_ms, growth = iterate(sizes.timed, sizes.repeats, gpu, on)
        cpu_ms, _ = iterate(sizes.timed, sizes.repeats // 4, cpu, torch.device("cpu"))
        found = [f"grows by {growth} bytes in {sizes.repeats} training steps"] if growth > 0 else []
        say(check="memory", faults=found, seconds=time.perf_counter() - start)
        say(gpu_ms=gpu_ms, cpu_ms=cpu_ms)
    except Exception as error:
        line = (str(error).strip().splitlines() or [""])[0]
        full = isinstance(error.__cause__ or error, torch.cuda.OutOfMemoryError)
        # A GPU that is busy, or not visible to this job, may pass next time.
        say(stopped=gpu_fault(error) or f"{type(error).__name__}: {line}", keep=started and not full)


if __name__ == "__main__":
    main()
