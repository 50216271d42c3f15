"""Benchmark of a GPU: our training iteration, the passes of gsplat, and the errors of both."""

from __future__ import annotations

import platform
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import torch
from torch import Tensor

import cleargs
from benchmarks.speed.benchmark_plan import BenchmarkCase, DevicePlan
from benchmarks.speed.benchmark_results import Times, named
from benchmarks.speed.gsplat_cuda import GsplatRasteriser, load_gsplat
from benchmarks.speed.iteration import Iteration
from benchmarks.speed.oracle import Accuracy, accuracy, choose_pixels, oracle
from benchmarks.speed.timing import Clock, EventClock, Quartiles, interleave, ratio
from cleargs.progress import Reporter
from cleargs.splat.camera import Camera
from cleargs.splat.gaussians import Gaussians
from cleargs.splat.kernels.cuda.pipeline import CudaRasteriser
from cleargs.splat.random_scene import random_scene

MEMORY_REPETITIONS = 3
"""Iterations over which the peak memory is taken."""


@dataclass(frozen=True)
class RasteriserResult:
    """Results of one rasteriser on one case."""

    times: Times
    memory: int | None  # peak bytes of its tensors; None without a GPU
    accuracy: Accuracy


@dataclass(frozen=True)
class DeviceRow:
    """Results of one case."""

    case: BenchmarkCase
    pairs: int  # (tile, splat)
    reached: int  # pairs before all pixels in their tile are opaque
    ours: RasteriserResult
    gsplat: RasteriserResult | None
    ratio: Quartiles | None  # forward and backward pass: gsplat's time / ours, per round


@dataclass(frozen=True)
class DeviceBenchmark:
    """Results of ``python -m benchmarks splat --device cuda``."""

    device: str
    versions: dict[str, str]
    gsplat_missing: str | None  # the reason if gsplat was not run
    rows: list[DeviceRow]

    def as_json(self) -> dict[str, Any]:
        """Return dictionaries and lists; a BenchmarkCase becomes a dictionary too."""
        plain: dict[str, Any] = asdict(self, dict_factory=named)
        return plain


class DeviceIteration(Iteration):
    """A training iteration as on a GPU: the trainer does not wait for the value of the loss."""

    def differentiate(self, image: Tensor) -> Tensor:
        """Return the gradient as in `Iteration`; the loss stays on the device."""
        self._losses.add(len(self._losses), image, self._target, gradient=self._gradient)
        return self._gradient

    def run_several(self, repetitions: int, clock: Clock) -> None:
        """Time ``repetitions`` iterations, then read their losses."""
        super().run_several(repetitions, clock)
        self._losses.take()


def run(plan: DevicePlan, device: torch.device, reporter: Reporter) -> Iterator[DeviceBenchmark]:
    """Measure case by case; yield all results so far, so that a time limit loses only the rest."""
    gsplat: Any = None
    missing: str | None = "runs on a GPU only"
    if device.type == "cuda":
        try:
            gsplat, missing = load_gsplat(), None
        except ImportError as error:
            missing = str(error)
    rows: list[DeviceRow] = []
    with reporter.task("measuring", len(plan.cases)) as task:
        for case in plan.cases:
            rows.append(measure(case, plan, device, gsplat))
            task.update(done=len(rows), note=case.title)
            yield DeviceBenchmark(device_name(device), versions(), missing, list(rows))


def measure(case: BenchmarkCase, plan: DevicePlan, device: torch.device, gsplat: Any | None) -> DeviceRow:
    """Measure one case; with ``gsplat``, time both rasterisers alternately."""
    gaussians, camera = random_scene(case.gaussians, case.width, case.height, sigma=case.sigma)
    truth = oracle(gaussians, camera, choose_pixels(camera, case.gaussians, plan.seed), plan.seed)
    make: dict[str, Callable[[], DeviceIteration | GsplatRasteriser]] = {
        "ours": partial(DeviceIteration, gaussians, camera, device)
    }
    if gsplat is not None:
        make["gsplat"] = partial(GsplatRasteriser, gsplat, gaussians, camera, device)
    memory = {name: peak_memory(device, made) for name, made in make.items()}
    rasterisers = {name: made() for name, made in make.items()}
    clocks = interleave(
        {name: partial(made.run_several, plan.repetitions) for name, made in rasterisers.items()},
        plan.rounds,
        EventClock if device.type == "cuda" else Clock,
    )
    sides = {
        name: RasteriserResult(
            clocks[name].quartiles(),
            memory[name],
            accuracy(truth, *made.image_and_gradients(truth.grad_image)),
        )
        for name, made in rasterisers.items()
    }
    passes = {name: clock.by_round("forward", "backward") for name, clock in clocks.items()}
    pairs, reached = count_pairs(gaussians.to(device), camera, device)
    return DeviceRow(
        case=case,
        pairs=pairs,
        reached=reached,
        ours=sides["ours"],
        gsplat=sides.get("gsplat"),
        ratio=ratio(passes["gsplat"], passes["ours"]) if gsplat is not None else None,
    )


def peak_memory(device: torch.device, make: Callable[[], DeviceIteration | GsplatRasteriser]) -> int | None:
    """Return the peak bytes of tensors while a new rasteriser runs; None without a GPU."""
    if device.type != "cuda":
        return None
    torch.cuda.empty_cache()
    torch.cuda.reset_peak_memory_stats(device)
    before = torch.cuda.memory_allocated(device)
    make().run_several(MEMORY_REPETITIONS, Clock())
    torch.cuda.synchronize(device)
    return torch.cuda.max_memory_allocated(device) - before


class _CountingRasteriser(CudaRasteriser):
    """The GPU rasteriser with access to its counts of pairs."""

    @property
    def work(self) -> tuple[int, int]:
        assert self._state is not None
        return len(self._state.pair_ids), int(self._state.deepest.sum())


def count_pairs(gaussians: Gaussians, camera: Camera, device: torch.device) -> tuple[int, int]:
    """Return the number of (tile, splat) pairs, and of those before all pixels in their tile are opaque."""
    rasteriser = _CountingRasteriser(device)
    rasteriser.forward(gaussians, camera)
    return rasteriser.work


def device_name(device: torch.device) -> str:
    """Return the GPU's name and memory."""
    if device.type != "cuda":
        return f"Triton's interpreter on {platform.machine()}"
    found = torch.cuda.get_device_properties(device)
    return f"{found.name}, {found.total_memory / 1e9:.0f} GB"


def versions() -> dict[str, str]:
    """Return the versions of software that affects the times; CUDA is that of PyTorch."""
    known = {"cleargs": cleargs.__version__, "python": platform.python_version()}
    for name in ("torch", "triton", "gsplat"):
        try:
            known[name] = version(name)
        except PackageNotFoundError:
            continue
    return known | {"CUDA": torch.version.cuda or "none"}
