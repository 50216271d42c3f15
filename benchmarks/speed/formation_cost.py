"""Cost of image formation in a training step, and its error against the true exposure.

It is compared with the usual way to include blur in the loss: the mean of N renders along the path, as in
"BAD-Gaussians" (Zhao et al. 2024) and "Deblur-GS" (Chen & Liu 2024).
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import Any

import cv2
import numpy as np
import torch
from torch import Tensor

from benchmarks.speed.benchmark_results import Machine, describe_machine
from benchmarks.speed.iteration import WHOLE, Iteration, use_threads
from benchmarks.speed.random_scenes import surface_scene
from benchmarks.speed.timing import Quartiles, interleave, ratio
from cleargs.formation.formed import FormedView
from cleargs.formation.frame import FrameFormation, displacement_of
from cleargs.formation.motion import TWIST, FrameMotion
from cleargs.formation.warp import displacement_fields, linear_curve, srgb_curve
from cleargs.progress import Reporter
from cleargs.splat.backend import backend_for, psnr, rasteriser_for
from cleargs.splat.camera import Camera
from cleargs.splat.gaussians import Gaussians
from cleargs.splat.kernels.rasteriser import Rasteriser
from cleargs.types import PlaneF32

PLAIN, FORMED = "sharp render", "formation"
"""A step without blur, and one with `cleargs.formation`."""

CPU = torch.device("cpu")

TRUTH_PER_PIXEL = 4
"""Number of renders per pixel of blur whose mean is the true exposure."""


@dataclass(frozen=True)
class FormationPlan:
    """Scene, blurs and repetitions of the benchmark."""

    gaussians: int = 50_000
    width: int = 640
    height: int = 360
    lengths: tuple[float, ...] = (3.0, 10.0, 30.0)
    """Mean lengths of the blurs, px."""
    renders: tuple[int, ...] = (3, 5, 9, 17)
    """Numbers of renders to average."""
    threads: int = 1
    rounds: int = 7
    repetitions: int = 3


@dataclass(frozen=True)
class FormationRow:
    """Results for one blur, by method: `PLAIN`, `FORMED` or ``N renders``."""

    length: float
    times: dict[str, Quartiles]
    """Time per step, ms."""
    ratio: dict[str, Quartiles]
    """Time / time of `PLAIN`, per round."""
    psnr: dict[str, float]
    """PSNR of the image against the true exposure, dB."""


@dataclass(frozen=True)
class FormationBenchmark:
    """Results for all blurs, and the machine."""

    machine: Machine
    plan: FormationPlan
    rows: list[FormationRow]

    def as_json(self) -> dict[str, Any]:
        """Return dictionaries and lists."""
        return asdict(self)


def plan_of(*, quick: bool, threads: int) -> FormationPlan:
    """Return the plan whose figures may be quoted, or with ``quick`` a small one to try the command."""
    if quick:
        return FormationPlan(2_000, 96, 54, (3.0, 10.0), (3, 9), threads, rounds=2, repetitions=1)
    return FormationPlan(threads=threads)


def run(plan: FormationPlan, reporter: Reporter) -> FormationBenchmark:
    """Measure each blur of the plan; its methods are timed alternately."""
    load = os.getloadavg()[0]
    use_threads(plan.threads)
    gaussians, camera = surface_scene(plan.gaussians, plan.width, plan.height)
    rows = []
    with reporter.task("measuring", len(plan.lengths)) as task:
        for length in plan.lengths:
            rows.append(_measure_blur(length, plan, gaussians, camera))
            task.update(done=len(rows), note=f"{length:g} px")
    return FormationBenchmark(describe_machine(load), plan, rows)


def motion_of(length: float, median_depth: float) -> FrameMotion:
    """Return a motion to the right and a rotation, each with half of the blur ``length`` in px."""
    blur = np.zeros(TWIST)
    blur[0] = blur[4] = 0.5 * length
    return FrameMotion(blur=blur, median_depth=median_depth)


def poses_along(camera: Camera, motion: FrameMotion, count: int) -> list[Camera]:
    """Return cameras at the centres of ``count`` equal parts of the exposure."""
    cameras = []
    for t in (np.arange(count) + 0.5) / count - 0.5:
        moved = np.eye(4)
        moved[:3, :3] = cv2.Rodrigues(-t * motion.blur[3:] / camera.fx)[0]
        moved[:3, 3] = -t * motion.blur[:3] * motion.median_depth / camera.fx
        cameras.append(replace(camera, world_to_camera=moved @ camera.world_to_camera))
    return cameras


def _measure_blur(length: float, plan: FormationPlan, gaussians: Gaussians, camera: Camera) -> FormationRow:
    methods = _methods(length, plan.renders, gaussians, camera)
    truth = _truth(length, gaussians, camera)
    clocks = interleave(
        {name: partial(method.run_several, plan.repetitions) for name, method in methods.items()}, plan.rounds
    )
    taken = {name: clock.by_round(WHOLE) for name, clock in clocks.items()}
    return FormationRow(
        length,
        times={name: clock.quartiles()[WHOLE] for name, clock in clocks.items()},
        ratio={name: ratio(values, taken[PLAIN]) for name, values in taken.items()},
        psnr={name: psnr(method.image(), truth, None) for name, method in methods.items()},
    )


def _methods(
    length: float, counts: Sequence[int], gaussians: Gaussians, camera: Camera
) -> Mapping[str, Iteration]:
    motion = motion_of(length, _median_depth(gaussians, camera))
    return {
        PLAIN: Iteration(gaussians, camera),
        FORMED: _FormedStep(gaussians, camera, motion),
        **{f"{n} renders": _MeanOfRenders(gaussians, camera, motion, n) for n in counts},
    }


def _truth(length: float, gaussians: Gaussians, camera: Camera) -> Tensor:
    """Return the exposure [H, W, 3]: the mean in linear light of many renders along the path, as sRGB."""
    motion = motion_of(length, _median_depth(gaussians, camera))
    engine, backend = rasteriser_for(), backend_for(CPU)
    total = np.zeros((camera.height, camera.width, 3))
    poses = poses_along(camera, motion, max(9, round(TRUTH_PER_PIXEL * length)))
    for pose in poses:
        total += backend.through_curve(engine.forward(gaussians, pose).image, linear_curve(CPU), 3)[0].numpy()
    mean = torch.from_numpy((total / len(poses)).astype(np.float32))
    return backend.through_curve(mean, srgb_curve(CPU), 3)[0]


def _median_depth(gaussians: Gaussians, camera: Camera) -> float:
    return float(np.median(_depth(rasteriser_for(), gaussians, camera)))


def _depth(engine: Rasteriser, gaussians: Gaussians, camera: Camera) -> PlaneF32:
    rendered = engine.forward(gaussians, camera, depth=True)
    assert rendered.depth is not None
    depth: PlaneF32 = rendered.depth.numpy() / np.maximum(rendered.alpha.numpy(), 1e-3)
    return depth


class _FormedStep(Iteration):
    """A step with `FormedView` and a known motion."""

    def __init__(self, gaussians: Gaussians, camera: Camera, motion: FrameMotion) -> None:
        super().__init__(gaussians, camera)
        depth = torch.from_numpy(_depth(self.engine, gaussians, camera))
        fields = displacement_fields(motion, camera, depth, torch.ones_like(depth))
        frame = FrameFormation(0, motion, "blur", displacement_px=displacement_of(fields))
        self._formed = FormedView(camera, 1.0, formation=frame)

    def image(self) -> Tensor:
        render = self.engine.forward(self.gaussians, self._formed.camera, depth=True)
        return self._formed.forward(render)

    def backward(self, gradient: Tensor) -> Gaussians:
        return self.engine.backward(self._formed.backward(gradient))


class _MeanOfRenders(Iteration):
    """A step on the mean of ``count`` renders along the path, in linear light."""

    def __init__(self, gaussians: Gaussians, camera: Camera, motion: FrameMotion, count: int) -> None:
        super().__init__(gaussians, camera)
        self._backend = backend_for(CPU)
        self._poses = poses_along(camera, motion, count)
        self._engines = [rasteriser_for() for _ in self._poses]

    def image(self) -> Tensor:
        total = torch.zeros(self.camera.height, self.camera.width, 3)
        self._slopes = []
        for engine, pose in zip(self._engines, self._poses, strict=True):
            image = engine.forward(self.gaussians, pose).image
            light, slope = self._backend.through_curve(image, linear_curve(CPU), 3)
            total += light
            self._slopes.append(slope)
        mean, self._slope_of_mean = self._backend.through_curve(total / len(self._poses), srgb_curve(CPU), 3)
        return mean

    def backward(self, gradient: Tensor) -> Gaussians:
        light = self._backend.times_slope(gradient, self._slope_of_mean, 3) / len(self._poses)
        found = [
            engine.backward(self._backend.times_slope(light, of_render, 3))
            for engine, of_render in zip(self._engines, self._slopes, strict=True)
        ]
        for name, total in found[0].tensors().items():
            for other in found[1:]:
                total += other.tensors()[name]
        return found[0]
