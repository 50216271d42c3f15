"""Runs a plan: every case timed on each number of threads in turn, and checked against the oracle."""

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
from benchmarks.speed.timing import Clock, Quartiles, ratio, take_turns
from benchmarks.speed.work import size_of, work_of
from cleargs.progress import Reporter
from cleargs.splat.gaussians import Gaussians
from cleargs.splat.pace import random_scene

RASTERISER = ("rasterise.forward", "rasterise.backward", "gradients.backpropagate")
"""Our side of the comparison of rasterisers. The last adds the pairs up per Gaussian, which torch's side does
too, and continues to the raw parameters, which it does not."""


def run(plan: Plan, reporter: Reporter) -> Benchmark:
    """Measure everything that ``plan`` names."""
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
    """Times, memory and errors of one case; the pure-torch rasteriser's too where the plan compares it."""
    use_threads(max(plan.threads))
    iteration = _iteration(case)
    size = size_of(projected_frame(iteration.gaussians, iteration.camera))
    truth = _truth(iteration, plan.seed)
    times = take_turns(
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
    """Rasteriser against rasteriser: ours and the one in pure torch take turns on the same splats."""
    other = torch_rasteriser(iteration)
    variants: dict[str, Callable[[Clock], object]] = {}
    for count in plan.threads:
        variants[f"ours {count}"] = partial(iteration.run_on, count, plan.repetitions)
        variants[f"torch {count}"] = partial(other.run_on, count, truth.grad_image)
    clocks = take_turns(variants, plan.torch_rounds)
    ours = {count: clocks[f"ours {count}"].by_round(*RASTERISER) for count in plan.threads}
    theirs = {count: clocks[f"torch {count}"].by_round("forward", "backward") for count in plan.threads}
    compared = TorchTimes(
        times={count: Quartiles.of(values) for count, values in theirs.items()},
        ratio={count: ratio(theirs[count], ours[count]) for count in plan.threads},
        accuracy=accuracy(truth, *other.image_and_gradients(truth.grad_image)),
    )
    return Rasterisers({count: Quartiles.of(values) for count, values in ours.items()}, compared)


def torch_rasteriser(iteration: Iteration) -> TorchRasteriser:
    """The rasteriser in pure torch, ready to run on a scene."""
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
    """A rasteriser in pure torch, in float32, behind the oracle's projection in float64."""

    def __init__(self, leaves: dict[str, Tensor], exact: Splats, render: Callable[[Splats], Tensor]) -> None:
        self._leaves = leaves
        self._exact = exact
        self._render = render
        self._splats = Splats(*(tensor.detach().float().requires_grad_() for tensor in exact))

    def run_on(self, threads: int, grad_image: Tensor, clock: Clock) -> None:
        """Forward and backward pass on so many threads, a repetition on ``clock``."""
        use_threads(threads)
        with clock.repetition():
            with clock.time("forward"):
                image = self._render(self._splats)
            with clock.time("backward"):
                torch.autograd.grad(image, self._splats[:4], grad_image)

    def image_and_gradients(self, grad_image: Tensor) -> tuple[Tensor, Gaussians]:
        """Image [H, W, 3] and gradients of the raw parameters; through the projection in float64."""
        image = self._render(self._splats)
        slopes = torch.autograd.grad(image, self._splats[:4], grad_image)
        gradients = torch.autograd.grad(
            self._exact[:4], list(self._leaves.values()), [slope.double() for slope in slopes]
        )
        return image.detach(), Gaussians(*gradients)


def measure_roofline(case: BenchmarkCase, plan: Plan) -> Rooflines:
    """The machine's peaks, and every kernel's share of what they allow."""
    iteration = _iteration(case)
    size = size_of(projected_frame(iteration.gaussians, iteration.camera))
    work = work_of(size)
    clocks = take_turns(
        {str(count): partial(iteration.run_on, count, plan.repetitions) for count in plan.threads},
        plan.rounds,
    )
    peaks = {count: measure_peaks(count, plan.peak_repeats) for count in plan.threads}
    kernels = {count: roofline(work, clocks[str(count)].quartiles(), peaks[count]) for count in plan.threads}
    return Rooflines(case, size, peaks, kernels)


def measure_scaling(series: dict[str, Sequence[BenchmarkCase]], plan: Plan) -> dict[str, list[ScalingPoint]]:
    """Forward and backward pass of every case, all in turn, on the most threads; and their memory."""
    iterations = {case: _iteration(case) for cases in series.values() for case in cases}
    threads = max(plan.threads)
    clocks = take_turns(
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
