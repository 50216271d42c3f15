"""Counts of work match the oracle; kernels are timed and restored; peaks, rooflines and fits."""

from __future__ import annotations

from importlib import import_module

import pytest
import torch

from benchmarks.speed import reference
from benchmarks.speed.iteration import Iteration, projected_frame
from benchmarks.speed.peaks import Peaks, measure_peaks
from benchmarks.speed.probe import KERNELS, PACKAGE, timed_kernels
from benchmarks.speed.roofline import roof, roofline
from benchmarks.speed.scaling import straight_line
from benchmarks.speed.timing import Clock, Quartiles, interleave, ratio
from benchmarks.speed.work import KernelWork, size_of, work_of
from cleargs.splat import constants
from cleargs.splat.gaussians import Gaussians
from cleargs.splat.kernels.cpu.backend import warm_up
from cleargs.splat.kernels.cpu.simd import LANES
from cleargs.splat.random_scene import random_scene


def test_contributions_match_the_oracle():
    gaussians, camera = random_scene(120, 45, 35, sigma=3.0, seed=0)
    gaussians.logit_opacities[:60] = 6.0
    exact = Gaussians(**{name: tensor.double() for name, tensor in gaussians.tensors().items()})
    view = reference.render(exact, camera)
    assert view.margin.min() > 1e-5, "float32 may fall on the other side of a cut-off: use another seed"
    splats = reference.project(exact, camera, 16, antialias=False)
    x, y = torch.arange(45) + 0.5, torch.arange(35) + 0.5
    dx = x.double()[None, :, None] - splats.means[:, 0]
    dy = y.double()[:, None, None] - splats.means[:, 1]
    a, b, c = splats.conics.unbind(-1)
    alpha = splats.opacities * torch.exp(-0.5 * (a * dx * dx + 2 * b * dx * dy + c * dy * dy))
    alpha = torch.where(alpha >= constants.ALPHA_CUT, alpha.clamp_max(constants.ALPHA_MAX), 0.0)
    after = torch.cumprod(1 - alpha, -1)
    assert (after[..., -1] < constants.TRANSMITTANCE_STOP).any()
    contributes = (alpha > 0) & (after >= constants.TRANSMITTANCE_STOP)
    expected = int(contributes.sum())
    starts = [contributes[:, start : start + LANES].any(1) for start in range(0, 45, LANES)]

    size = size_of(projected_frame(gaussians, camera))
    assert size.contributions == expected
    assert size.vectors == int(torch.stack(starts).sum())
    assert size.gaussians == 120 and size.pixels == 45 * 35
    assert expected / 256 <= size.pairs <= 120 * 9


def test_every_kernel_is_timed_and_restored():
    originals = [_kernel(name) for name in KERNELS]
    clock = Clock(rounds=[[]])
    iteration = Iteration(*random_scene(20, 33, 17))
    before = iteration.gaussians.clone()
    iteration.run_on(1, 2, clock)
    assert [_kernel(name) for name in KERNELS] == originals
    times = clock.quartiles()
    assert set(KERNELS) | {"forward", "loss", "backward", "adam", "iteration"} == set(times)
    assert len(clock.rounds[0]) == 2
    for repetition in clock.rounds[0]:
        kernels = sum(repetition[name] for name in KERNELS)
        assert 0 < kernels <= repetition["iteration"]
    assert all(
        torch.equal(tensor, before.tensors()[name]) for name, tensor in iteration.gaussians.tensors().items()
    )


def _kernel(name):
    module, function = name.split(".")
    return getattr(import_module(f"{PACKAGE}.{module}"), function)


def test_roof_is_the_slower_of_operations_and_bytes():
    peaks = Peaks(gflops=100.0, gbytes=10.0)
    bound = roof("k", KernelWork(operations=4e8, bytes=1e7), 8.0, peaks)  # at least 4 ms, and 1 ms
    assert (bound.bound, bound.fraction) == ("operations", pytest.approx(0.5))
    bound = roof("k", KernelWork(operations=1e8, bytes=6e7), 8.0, peaks)  # at least 1 ms, and 6 ms
    assert (bound.bound, bound.fraction) == ("bytes", pytest.approx(0.75))


def test_work_is_proportional_to_size():
    size = size_of(projected_frame(*random_scene(50, 33, 17)))
    once = work_of(size)
    twice = work_of(type(size)(*(2 * number for number in size)))
    assert list(once) == list(KERNELS)
    for name in KERNELS:
        assert twice[name] == pytest.approx(tuple(2 * x for x in once[name]))
        assert once[name].bytes > 0
    times = {name: Quartiles(1.0, 2.0, 3.0) for name in KERNELS}
    assert [r.milliseconds for r in roofline(once, times, Peaks(1.0, 1.0))] == [2.0] * len(KERNELS)


def test_peaks_are_measured():
    peaks = measure_peaks(1, 2, steps=1000, copy_bytes=1 << 16)
    assert peaks.gflops > 0 and peaks.gbytes > 0


def test_variants_are_interleaved():
    order: list[str] = []

    def variant(name, values):
        def run(clock):
            order.append(name)
            with clock.repetition():
                clock.add("work", values.pop(0))
                clock.add("work", 1.0)

        return run

    clocks = interleave({"a": variant("a", [9.0, 1.0, 3.0]), "b": variant("b", [9.0, 5.0, 7.0])}, rounds=2)
    assert order == ["a", "b", "a", "b", "b", "a"]
    assert clocks["a"].by_round("work") == [2.0, 4.0]
    assert clocks["b"].quartiles() == {"work": Quartiles(6.5, 7.0, 7.5)}
    assert ratio([2.0, 4.0], [6.0, 8.0]).median == pytest.approx((1 / 3 + 1 / 2) / 2)


def test_linear_fits():
    line = straight_line([(100, 7.0), (200, 12.0), (1000, 52.0)])
    assert line == pytest.approx((2.0, 0.05, 0.0), abs=1e-9)
    bent = straight_line([(100, 7.0), (200, 12.0), (1000, 104.0)])
    assert 0.1 < bent.deviation < 1
    assert straight_line([(4, 8.0)]) == pytest.approx((0.0, 2.0, 0.0))


def test_warm_up_runs_every_kernel_of_an_iteration():
    clock = Clock()
    with clock.repetition(), timed_kernels(clock):
        warm_up()
    assert set(clock.quartiles()) == set(KERNELS)
