"""The automatic choice of the device, and a GPU that fails during a run."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import torch
from onnxruntime.capi.onnxruntime_pybind11_state import Fail as OnnxFault
from toy import Bench, Square

from cleargs.digest import DigestMemo
from cleargs.errors import InputError, StageError
from cleargs.gpu import NO_GPU, Check, SelfTest
from cleargs.pipeline import session
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


@pytest.fixture
def gpu(monkeypatch: pytest.MonkeyPatch) -> Callable[[SelfTest | None], None]:
    """Return a function that sets the cached result of the self-test."""

    def known(tested: SelfTest | None) -> None:
        monkeypatch.setattr(session, "cuda_obstacle", lambda: None)
        monkeypatch.setattr(session, "current_facts", lambda: FACTS)
        monkeypatch.setattr(session, "cached_test", lambda facts: tested)

    return known


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
def test_auto_says_in_one_line_what_it_chose(
    tested: SelfTest | None, device: str, line: str, gpu: Callable[[SelfTest | None], None]
) -> None:
    gpu(tested)
    lines: list[str] = []
    assert resolve_device("auto", lines.append) == device
    assert lines == [line]
    assert resolve_device("cpu", lines.append) == "cpu"
    assert resolve_device("cuda", lines.append) == "cuda"
    assert lines == [line]


def test_auto_tests_a_gpu_that_is_new(
    gpu: Callable[[SelfTest | None], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    gpu(None)
    monkeypatch.setattr(session, "self_test", lambda facts, say: PASSED)
    assert resolve_device("auto", lambda line: None) == "cpu"
    assert resolve_device("auto", lambda line: None, test=True) == "cuda"


def test_without_a_gpu_there_is_no_test_and_no_message(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*given: object) -> None:
        raise AssertionError("there is no GPU to ask")

    monkeypatch.setattr(session, "cuda_obstacle", lambda: NO_GPU)
    monkeypatch.setattr(session, "current_facts", refuse)
    lines: list[str] = []
    assert resolve_device("auto", lines.append, test=True) == "cpu"
    assert not lines
    monkeypatch.setattr(session, "cuda_obstacle", lambda: "Triton is not installed")
    assert resolve_device("auto", lines.append, test=True) == "cpu"
    assert lines == ["device: the CPU, because Triton is not installed"]


def test_a_run_keeps_its_device(gpu: Callable[[SelfTest | None], None]) -> None:
    lines: list[str] = []
    gpu(PASSED)
    assert resolve_device("auto", lines.append, kept="cpu") == "cpu"
    gpu(SLOW)
    assert resolve_device("auto", lines.append, kept="cuda") == "cuda"
    gpu(FAILED)
    assert resolve_device("cuda", lines.append, kept="cuda") == "cuda"
    with pytest.raises(InputError, match="the run used the GPU, but the GPU failed") as caught:
        resolve_device("auto", lines.append, kept="cuda")
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
