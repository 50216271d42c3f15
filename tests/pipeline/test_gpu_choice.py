"""The automatic choice of the device, and a GPU that fails during a run."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch
from onnxruntime.capi.onnxruntime_pybind11_state import Fail as OnnxFault
from toy import Bench, Square

from cleargs.digest import DigestMemo
from cleargs.errors import InputError, StageError
from cleargs.gpu import NO_GPU, Check, Machine, SelfTest
from cleargs.pipeline.runner import Runner
from cleargs.pipeline.session import resolve_device
from cleargs.pipeline.stage import StageContext, StageResult
from cleargs.pipeline.stages import Stages
from cleargs.pipeline.store import Store
from cleargs.stages import gpu_fault

FACTS = {"gpu": "NVIDIA A1", "driver": "550.54.15"}
PASSED = SelfTest(FACTS, [Check("Adam", [], 1.0)], gpu_ms=2.0, cpu_ms=60.0)
FAILED = SelfTest(FACTS, [Check("Adam", ["means: differs by 1"], 1.0)], gpu_ms=2.0, cpu_ms=60.0)
SLOW = PASSED._replace(gpu_ms=90.0)


def machine(tested: SelfTest | None, obstacle: str | None = None) -> Machine:
    """A machine with a GPU, and with this cached result of its self-test. A new test would pass."""
    return Machine(lambda: obstacle, lambda: FACTS, lambda facts: tested, lambda facts, say: PASSED)


# -- the choice --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("tested", "device", "line"),
    [
        (
            PASSED,
            "cuda",
            "device: the GPU, because NVIDIA A1 passed its self-test; "
            "a training step takes 2 ms on the GPU, 60 ms on the CPU",
        ),
        (
            SLOW,
            "cpu",
            "device: the CPU, because NVIDIA A1 passed its self-test; "
            "a training step takes 90 ms on the GPU, 60 ms on the CPU",
        ),
        (
            FAILED,
            "cpu",
            "device: the CPU, because the GPU failed its self-test (Adam: means: differs by 1); "
            "cleargs doctor --gpu repeats it",
        ),
        (None, "cpu", "device: the CPU, because the GPU is not tested yet (cleargs doctor --gpu tests it)"),
    ],
)
def test_auto_says_in_one_line_what_it_chose(tested: SelfTest | None, device: str, line: str) -> None:
    lines: list[str] = []
    asked = machine(tested)
    assert resolve_device("auto", lines.append, machine=asked) == device
    assert lines == [line]
    assert resolve_device("cpu", lines.append, machine=asked) == "cpu"
    assert resolve_device("cuda", lines.append, machine=asked) == "cuda"
    assert lines == [line]


def test_auto_tests_a_gpu_that_is_new() -> None:
    asked = machine(None)
    assert resolve_device("auto", lambda line: None, machine=asked) == "cpu"
    assert resolve_device("auto", lambda line: None, test=True, machine=asked) == "cuda"


def test_without_a_gpu_there_is_no_test_and_no_message() -> None:
    def refuse() -> dict[str, str]:
        raise AssertionError("there is no GPU to ask")

    lines: list[str] = []
    none = Machine(lambda: NO_GPU, refuse)
    assert resolve_device("auto", lines.append, test=True, machine=none) == "cpu"
    assert not lines
    useless = Machine(lambda: "Triton is not installed", refuse)
    assert resolve_device("auto", lines.append, test=True, machine=useless) == "cpu"
    assert lines == ["device: the CPU, because Triton is not installed"]


def test_a_run_keeps_its_device() -> None:
    lines: list[str] = []
    assert resolve_device("auto", lines.append, kept="cpu", machine=machine(PASSED)) == "cpu"
    assert resolve_device("auto", lines.append, kept="cuda", machine=machine(SLOW)) == "cuda"
    assert resolve_device("cuda", lines.append, kept="cuda", machine=machine(FAILED)) == "cuda"
    with pytest.raises(InputError, match="the run used the GPU, but the GPU failed") as caught:
        resolve_device("auto", lines.append, kept="cuda", machine=machine(FAILED))
    assert "--device cpu" in caught.value.hint
    assert not lines


# -- a GPU that fails later --------------------------------------------------------------------------------


class Breaking(Square):
    """A stage that fails on the GPU."""

    error: Exception

    def run(self, context: StageContext[Any]) -> StageResult:
        if context.device == "cuda":
            raise self.error
        return super().run(context)


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (
            RuntimeError("CUDA error: an illegal memory access was encountered\nmore"),
            "RuntimeError: CUDA error",
        ),
        (
            torch.cuda.OutOfMemoryError("CUDA out of memory. Tried to allocate 9 GiB."),
            "the GPU's memory is full",
        ),
        (OnnxFault("[ONNXRuntimeError] : 1 : FAIL : CUDA failure 700"), "Fail: [ONNXRuntimeError]"),
    ],
)
def test_a_gpu_that_fails_ends_the_run_with_its_cause(error: Exception, words: str, bench: Bench) -> None:
    stages = {name: bench.dag.load(name) for name in bench.dag.names}
    stages["square"] = broken = Breaking(bench.journal)
    broken.error = error
    dag = Stages(bench.dag.names, stages.__getitem__, gpu_fault)
    run = replace(bench.settings(), device="cuda")
    with DigestMemo(run.store / "digests.json") as memo:
        runner = Runner(dag, run, Store(run.store, memo), 1, bench.remarks)
        with pytest.raises(StageError, match=r"square: the GPU failed \(") as caught:
            runner.run_until()
        assert words in str(caught.value) and "\n" not in str(caught.value)
        assert "--device cpu" in caught.value.hint and caught.value.__cause__ is error
        broken.error = ValueError("not the GPU")
        with pytest.raises(ValueError, match="not the GPU"):
            runner.run_until()
