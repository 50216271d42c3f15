"""The self-test of a GPU. The interpreter replaces a GPU that passes, planted faults replace others."""

from __future__ import annotations

import itertools
import sys
from collections.abc import Callable
from pathlib import Path
from subprocess import CalledProcessError
from typing import Any

import pytest
import torch

from cleargs import gpu
from cleargs.gpu import SelfTest

CHILD = Path(__file__).with_name("self_test_child.py")
FACTS = {"gpu": "Triton's interpreter", "driver": "none"}


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the folder of cached results."""
    monkeypatch.setattr(gpu, "cache_folder", lambda name: tmp_path)
    return tmp_path


def in_child(fault: str, **options: Any) -> SelfTest:
    return gpu.self_test(FACTS, lambda line: None, command=[sys.executable, str(CHILD), fault], **options)


@pytest.mark.skipif(torch.cuda.is_available(), reason="run.sh runs the self-test itself on a GPU")
def test_the_interpreter_passes(cache: Path) -> None:
    tested = in_child("pass")
    assert tested.fault is None, tested.lines()
    assert len(tested.checks) == 9
    assert all(check.seconds for check in tested.checks)
    assert gpu.cached_test(FACTS) == tested
    assert gpu.cached_test({**FACTS, "driver": "another"}) is None
    # The interpreter is slow.
    assert tested.device == "cpu"
    assert "Triton's interpreter passed its self-test; a training step takes" in tested.reason


@pytest.mark.parametrize(
    ("fault", "sentence"),
    [("hang", "loss and colour: not done after 25 s"), ("crash", "loss and colour: ended by signal 11")],
)
def test_a_kernel_that_ends_nothing_or_all(fault: str, sentence: str) -> None:
    tested = in_child(fault, limit_s=25.0)
    assert tested.fault == sentence
    assert tested.device == "cpu"
    assert gpu.cached_test(FACTS) == tested


@pytest.fixture
def run(
    device: torch.device, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Callable[..., SelfTest]:
    """Return a function that runs the check of the loss, and perhaps that of the memory, in this process."""
    monkeypatch.syspath_prepend(str(CHILD.parent))
    import self_test_child

    from cleargs.splat.kernels.cuda import self_test

    loss = self_test.checks(self_test_child.ONE_CHECK)["loss and colour"]
    monkeypatch.setattr(self_test, "checks", lambda sizes: {"loss and colour": loss})

    def run(device: str = str(device), *, timed: bool = False) -> SelfTest:
        if not timed:  # it takes seconds in the interpreter
            monkeypatch.setattr(self_test, "iterate", lambda *given: (2.0, 0))
        capsys.readouterr()
        self_test.main(device, self_test_child.ONE_CHECK)
        return gpu.read_result(FACTS, capsys.readouterr().out)

    return run


def plant(monkeypatch: pytest.MonkeyPatch, error: Exception) -> None:
    """Let the loss fail with ``error``."""

    def fail(*given: object, **options: object) -> None:
        raise error

    from cleargs.splat.kernels.cuda import backend

    monkeypatch.setattr(backend, "loss_sums", fail)


@pytest.mark.skipif(torch.cuda.is_available(), reason="a kernel that is compiled keeps its constants")
def test_a_wrong_kernel(run: Callable[..., SelfTest], monkeypatch: pytest.MonkeyPatch) -> None:
    window = [1.01 * weight for weight in gpu_window()]
    from cleargs.splat.kernels.cuda import device_layout

    monkeypatch.setattr(device_layout, "SSIM_WINDOW", tuple(window))
    tested = run()
    (loss,) = (check for check in tested.checks if check.faults)
    assert loss.name == "loss and colour"
    assert loss.faults[0].startswith("loss: differs by ")
    assert "gradient of the loss with a mask: differs by" in "\n".join(tested.lines())
    assert tested.device == "cpu" and "failed its self-test (loss and colour: loss: differs" in tested.reason


def gpu_window() -> tuple[float, ...]:
    from cleargs.splat.kernels.cuda.device_layout import SSIM_WINDOW

    return SSIM_WINDOW


def test_a_kernel_that_differs_from_run_to_run(
    run: Callable[..., SelfTest], monkeypatch: pytest.MonkeyPatch
) -> None:
    from cleargs.splat.kernels.cuda import backend

    right, factors = backend.apply_affine, itertools.cycle((1.0, 1.0 + 1e-6))
    monkeypatch.setattr(backend, "apply_affine", lambda *given: right(*given) * next(factors))
    assert run().fault == "loss and colour: colour affine: has different bits in two runs on the GPU"


def test_values_that_are_not_finite(run: Callable[..., SelfTest], monkeypatch: pytest.MonkeyPatch) -> None:
    from cleargs.splat.kernels.cuda import backend

    monkeypatch.setattr(backend, "apply_affine", lambda image, affine: image * float("nan"))
    assert run().fault == "loss and colour: colour affine: has values that are not finite"


def test_a_memory_that_grows(run: Callable[..., SelfTest], monkeypatch: pytest.MonkeyPatch) -> None:
    held = itertools.count(100, 512)
    monkeypatch.setattr(torch.cuda, "memory_allocated", lambda *device: next(held))
    assert run(timed=True).fault == "memory: grows by 512 bytes in 4 training steps"


def test_a_full_memory_is_not_kept(run: Callable[..., SelfTest], monkeypatch: pytest.MonkeyPatch) -> None:
    plant(monkeypatch, torch.cuda.OutOfMemoryError("CUDA out of memory. Tried to allocate 2 GiB.\nMore."))
    tested = run()
    expected = "loss and colour: the GPU's memory is full: CUDA out of memory. Tried to allocate 2 GiB."
    assert tested.fault == expected
    assert not tested.keep


@pytest.mark.parametrize(
    ("error", "sentence"),
    [
        (
            RuntimeError("Triton Error [CUDA]: an illegal memory access was encountered"),
            "RuntimeError: Triton Error [CUDA]: an illegal memory access was encountered",
        ),
        (ValueError("no such thing\nmore"), "ValueError: no such thing"),
        # The two of triton/runtime/build.py.
        (
            RuntimeError("Failed to find C compiler. Please specify via CC environment variable or set ..."),
            "Triton needs a C compiler: install gcc or clang",
        ),
        (
            CalledProcessError(1, ["/usr/bin/gcc", "/tmp/tmpabc/cuda_utils.c", "-O3", "-shared"]),
            "Triton's C compiler failed: the headers of Python (python3-dev) may be missing",
        ),
    ],
)
def test_a_launch_that_fails(
    run: Callable[..., SelfTest], monkeypatch: pytest.MonkeyPatch, error: Exception, sentence: str
) -> None:
    plant(monkeypatch, error)
    tested = run()
    assert tested.fault == f"loss and colour: {sentence}"
    assert tested.keep


def test_a_kernel_that_asks_for_too_much(
    run: Callable[..., SelfTest], monkeypatch: pytest.MonkeyPatch
) -> None:
    from triton.runtime.errors import OutOfResources

    plant(monkeypatch, OutOfResources(300_000, 232_448, "shared memory"))
    assert "OutOfResources: out of resource: shared memory, Required: 300000" in str(run().fault)


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (
            "Found no NVIDIA driver on your system. Please check that you have an NVIDIA GPU and installed a "
            "driver from http://www.nvidia.com/Download/index.aspx",
            "PyTorch finds no NVIDIA driver",
        ),
        (
            "The NVIDIA driver on your system is too old (found version 11040). Please update your GPU "
            "driver by downloading and installing a new version.",
            "the NVIDIA driver is too old for this PyTorch",
        ),
    ],
)
def test_a_driver_that_is_missing_or_too_old(
    run: Callable[..., SelfTest], monkeypatch: pytest.MonkeyPatch, words: str, sentence: str
) -> None:
    """The words are those of torch/csrc/cuda/Module.cpp and c10/cuda/CUDAFunctions.cpp."""

    def fail() -> None:
        raise RuntimeError(words)

    monkeypatch.setattr(torch.cuda, "init", fail)
    tested = run("cuda")
    assert str(tested.fault).startswith(f"the start of CUDA: {sentence}")
    assert not tested.keep
