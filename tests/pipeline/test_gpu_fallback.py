"""The automatic choice of the device, and a GPU whose kernels fail during a run."""

from __future__ import annotations

import tomllib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from onnxruntime.capi.onnxruntime_pybind11_state import Fail as OnnxFault
from toy import Bench, Square, make_bench

from cleargs.batch.loop import Batch
from cleargs.batch.sheet import SceneJob
from cleargs.digest import DigestMemo
from cleargs.errors import ConfigError, InputError, StageError
from cleargs.gpu import NO_GPU, Check, SelfTest
from cleargs.pipeline import session
from cleargs.pipeline.run_file import read_run_file
from cleargs.pipeline.runner import Runner, StageOutcome
from cleargs.pipeline.session import DeviceChoice, resolve_device, resolve_run
from cleargs.pipeline.stage import StageContext, StageResult
from cleargs.pipeline.stages import Stages
from cleargs.pipeline.store import Store
from cleargs.stages import gpu_fault

FACTS = {"gpu": "NVIDIA A1", "driver": "550.54.15"}
PASSED = SelfTest(FACTS, [Check("Adam", [], 1.0)], gpu_ms=2.0, cpu_ms=60.0)
FAILED = SelfTest(FACTS, [Check("Adam", ["means: differs by 1"], 1.0)], gpu_ms=2.0, cpu_ms=60.0)
SLOW = PASSED._replace(gpu_ms=90.0)
ILLEGAL = RuntimeError("CUDA error: an illegal memory access was encountered\nmore lines")


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


# -- a kernel that fails later -----------------------------------------------------------------------------


class Breaking(Square):
    """A stage that fails on the GPU after its first file."""

    error: Exception | None = ILLEGAL
    bare: bool = False

    def run(self, context: StageContext[Any]) -> StageResult:
        if context.device == "cuda" and self.error is not None:
            (context.out / "powers").mkdir(exist_ok=True)
            (context.out / "powers" / "000.txt").write_text("half a result of the GPU")
            if self.bare:
                raise self.error
            raise StageError("square stopped", hint="no idea") from self.error
        return super().run(context)


@pytest.fixture
def breaking(bench: Bench, gpu: Callable[[SelfTest | None], None]) -> Bench:
    """Return a toy run on a machine whose GPU passed its self-test."""
    gpu(PASSED)
    stages = {name: bench.dag.load(name) for name in bench.dag.names}
    stages["square"] = Breaking(bench.journal)
    return replace(bench, dag=Stages(bench.dag.names, stages.__getitem__, gpu_fault=gpu_fault))


def run_on(
    bench: Bench,
    device: DeviceChoice,
    *,
    until: str | None = None,
    folder: Path | None = None,
    store: Path | None = None,
) -> list[StageOutcome]:
    """Call ``cleargs run --device DEVICE``."""
    (recipe := bench.root / "toy.toml").write_text("seed = 0\n")
    settings = resolve_run(
        bench.dag,
        bench.capture,
        folder or bench.folder,
        recipe=str(recipe),
        store=store,
        device=device,
        reporter=bench.remarks,
    )
    with DigestMemo(settings.store / "digests.json") as memo:
        runner = Runner(bench.dag, settings, Store(settings.store, memo), 1, bench.remarks)
        return runner.run_until(until)


def devices(outcomes: list[StageOutcome]) -> dict[str, str]:
    return {outcome.stage: outcome.manifest.device for outcome in outcomes}


def test_a_stage_whose_kernels_fail_starts_again_on_the_cpu(breaking: Bench, tmp_path: Path) -> None:
    outcomes = run_on(breaking, "auto")
    assert devices(outcomes) == {"count": "cuda", "square": "cpu", "total": "cpu"}
    assert breaking.remarks.warnings == [
        "square: the GPU failed (RuntimeError: CUDA error: an illegal memory access was encountered); "
        "square, total run on the CPU, square from its start. Finished stages are kept. "
        "Try the GPU again with --device cuda"
    ]
    assert tomllib.loads((breaking.folder / "run.toml").read_text())["on_cpu"] == ["square", "total"]
    # The same keys and bytes as without a GPU.
    (tmp_path / "other").mkdir()
    elsewhere = make_bench(tmp_path / "other").run()
    for found, expected in list(zip(outcomes, elsewhere, strict=True))[1:]:
        assert (found.manifest.key, found.manifest.digest) == (
            expected.manifest.key,
            expected.manifest.digest,
        )
    assert outcomes[0].manifest.key != elsewhere[0].manifest.key
    assert outcomes[0].manifest.digest == elsewhere[0].manifest.digest


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (
            torch.cuda.OutOfMemoryError("CUDA out of memory. Tried to allocate 9 GiB."),
            "the GPU's memory is full",
        ),
        (OnnxFault("[ONNXRuntimeError] : 1 : FAIL : CUDA failure 700"), "Fail: [ONNXRuntimeError]"),
    ],
)
def test_errors_of_the_gpu(
    error: Exception, words: str, breaking: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Breaking, "error", error)
    assert devices(run_on(breaking, "auto"))["square"] == "cpu"
    assert f"the GPU failed ({words}" in breaking.remarks.warnings[0]


def test_later_calls_find_all_of_it(breaking: Bench) -> None:
    run_on(breaking, "auto")
    breaking.work_done()
    breaking.remarks.warnings.clear()
    assert [outcome.how for outcome in run_on(breaking, "auto")] == ["found"] * 3
    assert breaking.work_done() == []
    assert not breaking.remarks.warnings
    seen = read_run_file(breaking.folder, breaking.dag)
    assert [seen.device_of(name) for name in breaking.dag.names] == ["cuda", "cpu", "cpu"]


def test_the_gpu_is_tried_again_when_it_is_named(breaking: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    run_on(breaking, "auto")
    with pytest.raises(StageError, match="square stopped"):
        run_on(breaking, "cuda")
    monkeypatch.setattr(Breaking, "error", None)
    assert devices(run_on(breaking, "cuda")) == dict.fromkeys(breaking.dag.names, "cuda")
    assert "on_cpu" not in (breaking.folder / "run.toml").read_text()
    assert devices(run_on(breaking, "auto")) == dict.fromkeys(breaking.dag.names, "cuda")


def test_a_gpu_that_is_named_ends_the_run_with_a_cause(
    breaking: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Breaking, "bare", True)
    with pytest.raises(StageError, match=r"square: the GPU failed \(RuntimeError: CUDA error") as caught:
        run_on(breaking, "cuda")
    assert "--device cpu" in caught.value.hint


def test_other_errors_stop_the_run(breaking: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Breaking, "error", ValueError("not the GPU"))
    with pytest.raises(StageError, match="square stopped"):
        run_on(breaking, "auto")
    assert not breaking.remarks.warnings


def test_a_single_stage_falls_back_too(breaking: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(StageError):
        run_on(breaking, "cuda")
    assert devices(run_on(breaking, "auto", until="square"))["square"] == "cpu"
    assert read_run_file(breaking.folder, breaking.dag).on_cpu == ("square", "total")


def test_a_damaged_list_of_stages_is_an_error(breaking: Bench) -> None:
    run_on(breaking, "auto")
    path = breaking.folder / "run.toml"
    path.write_text(path.read_text().replace('"square",', "1,"))
    with pytest.raises(ConfigError, match="damaged"):
        read_run_file(breaking.folder, breaking.dag)


def test_a_batch_finds_a_scene_that_left_the_gpu(breaking: Bench) -> None:
    scene = SceneJob("barn", breaking.capture, str(breaking.root / "toy.toml"), (), "line 1")
    batch = Batch(breaking.dag, breaking.root / "batch", [scene], "cuda", falls_back=True)
    assert "--device auto" in " ".join(batch.arguments(scene))
    run_on(breaking, "auto", folder=batch.run_folder(scene), store=batch.folder / "store")
    assert batch.result(scene).state == "done"
    named = replace(batch, falls_back=False)
    assert "--device cuda" in " ".join(named.arguments(scene))
    assert named.result(scene).state == "waiting"
