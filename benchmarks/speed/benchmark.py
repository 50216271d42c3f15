"""Measure the cases of a plan: time for each number of threads, memory, and error against the oracle."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from functools import partial

import torch
from torch import Tensor

from benchmarks.speed import reference, torch_tiles
from benchmarks.speed.benchmark_plan import BenchmarkCase, Plan
from benchmarks.speed.benchmark_results import (
    Benchmark,
    Rasterisers,
    ResultRow,
    Rooflines,
    ScalingPoint,
    TorchTimes,
    describe_machine,
)
from benchmarks.speed.iteration import Iteration, projected_frame, use_threads
from benchmarks.speed.oracle import Accuracy, Truth, accuracy, choose_pixels, oracle
from benchmarks.speed.peak_memory import peak_memory
from benchmarks.speed.peaks import measure_peaks
from benchmarks.speed.reference import Splats
from benchmarks.speed.roofline import roofline
from benchmarks.speed.timing import Clock, Quartiles, interleave, ratio
from benchmarks.speed.work import size_of, work_of
from cleargs.progress import Reporter
from cleargs.splat.gaussians import Gaussians
from cleargs.splat.random_scene import random_scene

RASTERISER = ("rasterise.forward", "rasterise.backward", "gradients.backpropagate")
"""Kernels of ClearGS in the comparison of rasterisers. The last one adds the pairs' gradients, as autograd
does for torch. It also computes gradients of the raw parameters, which torch does not."""


def run(plan: Plan, reporter: Reporter) -> Benchmark:
    """Measure all cases of ``plan``."""
    load = os.getloadavg()[0]
    steps = len(plan.cases) + (plan.roofline is not None) + 1
    with reporter.task("measuring", steps) as task:
        rows = []
        for case in plan.cases:
            rows.append(measure(case, plan))
            task.update(done=len(rows), note=case.title)
        roofs = None
        if plan.roofline is not None:
            roofs = measure_roofline(plan.roofline, plan)
            task.advance()
        scaling = measure_scaling(
            {"more splats": plan.more_splats, "larger splats": plan.larger_splats}, plan
        )
        task.advance()
    return Benchmark(describe_machine(load), plan.threads, rows, roofs, scaling)


def measure(case: BenchmarkCase, plan: Plan) -> ResultRow:
    """Measure one case, and the pure-torch rasteriser on it if the plan asks for that."""
    use_threads(max(plan.threads))
    iteration = _iteration(case)
    size = size_of(projected_frame(iteration.gaussians, iteration.camera))
    truth = _truth(iteration, plan.seed)
    times = interleave(
        {str(count): partial(iteration.run_on, count, plan.repetitions) for count in plan.threads},
        plan.rounds,
    )
    return ResultRow(
        case=case,
        pairs=size.pairs,
        contributions=size.contributions,
        times={count: times[str(count)].quartiles() for count in plan.threads},
        memory=peak_memory(*case) if plan.memory else None,
        accuracy=_accuracy(truth, iteration),
        rasterisers=compare_rasterisers(iteration, truth, plan) if plan.compares_torch(case) else None,
    )


def compare_rasterisers(iteration: Iteration, truth: Truth, plan: Plan) -> Rasterisers:
    """Time our rasteriser and the one in pure torch alternately on the same splats."""
    other = torch_rasteriser(iteration)
    variants: dict[str, Callable[[Clock], object]] = {}
    for count in plan.threads:
        variants[f"ours {count}"] = partial(iteration.run_on, count, plan.repetitions)
        variants[f"torch {count}"] = partial(other.run_on, count, truth.grad_image)
    clocks = interleave(variants, plan.torch_rounds)
    ours = {count: clocks[f"ours {count}"].by_round(*RASTERISER) for count in plan.threads}
    theirs = {count: clocks[f"torch {count}"].by_round("forward", "backward") for count in plan.threads}
    compared = TorchTimes(
        times={count: Quartiles.of(values) for count, values in theirs.items()},
        ratio={count: ratio(theirs[count], ours[count]) for count in plan.threads},
        accuracy=accuracy(truth, *other.image_and_gradients(truth.grad_image)),
    )
    return Rasterisers({count: Quartiles.of(values) for count, values in ours.items()}, compared)


def torch_rasteriser(iteration: Iteration) -> TorchRasteriser:
    """Return the rasteriser in pure torch for the scene of ``iteration``."""
    tensors = iteration.gaussians.tensors()
    leaves = {name: tensor.double().requires_grad_() for name, tensor in tensors.items()}
    camera = iteration.camera
    exact = reference.project(Gaussians(**leaves), camera, iteration.gaussians.sh.shape[1], antialias=False)
    detached = Splats(*(tensor.detach() for tensor in exact))
    size = (camera.width, camera.height)
    counts, ids = torch_tiles.tile_lists(detached, *size)
    stacked = torch_tiles.groups(counts, ids, len(detached.depths))
    return TorchRasteriser(leaves, exact, lambda splats: torch_tiles.rasterise(splats, stacked, *size))


class TorchRasteriser:
    """A float32 rasteriser in pure torch, after the oracle's projection in float64."""

    def __init__(self, leaves: dict[str, Tensor], exact: Splats, render: Callable[[Splats], Tensor]) -> None:
        self._leaves = leaves
        self._exact = exact
        self._render = render
        self._splats = Splats(*(tensor.detach().float().requires_grad_() for tensor in exact))

    def run_on(self, threads: int, grad_image: Tensor, clock: Clock) -> None:
        """Time forward and backward pass on ``threads`` threads; ``grad_image`` is dL/d(image) [H, W, 3]."""
        use_threads(threads)
        with clock.repetition():
            with clock.time("forward"):
                image = self._render(self._splats)
            with clock.time("backward"):
                torch.autograd.grad(image, self._splats[:4], grad_image)

    def image_and_gradients(self, grad_image: Tensor) -> tuple[Tensor, Gaussians]:
        """Return the image [H, W, 3] and the gradients of the raw parameters for dL/d(image) [H, W, 3]."""
        image = self._render(self._splats)
        grad_splats = torch.autograd.grad(image, self._splats[:4], grad_image)
        gradients = torch.autograd.grad(
            self._exact[:4], list(self._leaves.values()), [gradient.double() for gradient in grad_splats]
        )
        return image.detach(), Gaussians(*gradients)


def measure_roofline(case: BenchmarkCase, plan: Plan) -> Rooflines:
    """Measure the machine's peaks, and each kernel's time relative to them."""
    iteration = _iteration(case)
    size = size_of(projected_frame(iteration.gaussians, iteration.camera))
    work = work_of(size)
    clocks = interleave(
        {str(count): partial(iteration.run_on, count, plan.repetitions) for count in plan.threads},
        plan.rounds,
    )
    peaks = {count: measure_peaks(count, plan.peak_repeats) for count in plan.threads}
    kernels = {count: roofline(work, clocks[str(count)].quartiles(), peaks[count]) for count in plan.threads}
    return Rooflines(case, size, peaks, kernels)


def measure_scaling(series: dict[str, Sequence[BenchmarkCase]], plan: Plan) -> dict[str, list[ScalingPoint]]:
    """Measure forward and backward pass of all cases alternately, on the largest number of threads."""
    iterations = {case: _iteration(case) for cases in series.values() for case in cases}
    threads = max(plan.threads)
    clocks = interleave(
        {str(case): partial(iteration.run_on, threads, 1) for case, iteration in iterations.items()},
        plan.rounds,
    )
    points = {
        case: ScalingPoint(
            case=case,
            pairs=len(projected_frame(iteration.gaussians, iteration.camera).pair_ids),
            milliseconds=Quartiles.of(clocks[str(case)].by_round("forward", "backward")),
            memory=peak_memory(*case) if plan.memory else None,
        )
        for case, iteration in iterations.items()
    }
    return {name: [points[case] for case in cases] for name, cases in series.items()}


def _iteration(case: BenchmarkCase) -> Iteration:
    return Iteration(*random_scene(case.gaussians, case.width, case.height, sigma=case.sigma))


def _truth(iteration: Iteration, seed: int) -> Truth:
    pixels = choose_pixels(iteration.camera, iteration.gaussians.num, seed)
    return oracle(iteration.gaussians, iteration.camera, pixels, seed)


def _accuracy(truth: Truth, iteration: Iteration) -> Accuracy:
    return accuracy(truth, *iteration.image_and_gradients(truth.grad_image))
