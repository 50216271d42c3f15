"""Device of networks in runs on a GPU, and batches that fit its memory, tested without a GPU."""

from __future__ import annotations

from typing import Any

import numpy as np
import onnxruntime
import pytest
from numpy.typing import NDArray

from cleargs.errors import StageError
from cleargs.models import tiling
from cleargs.models.expert import OnnxExpert
from cleargs.models.onnx import CUDA_PROVIDER, OnnxModel, in_batches, network_device
from cleargs.models.registry import model_file
from cleargs.models.scorer import CLARITY, LearnedScorer

Floats = NDArray[np.float32]


@pytest.fixture
def warnings() -> list[str]:
    return []


@pytest.fixture
def with_provider(monkeypatch: pytest.MonkeyPatch) -> None:
    """Simulate an onnxruntime with the CUDA provider, which cannot load here."""
    monkeypatch.setattr(onnxruntime, "get_available_providers", lambda: [CUDA_PROVIDER])


def test_cpu_work_gives_no_warning(warnings: list[str], with_provider: None) -> None:
    assert network_device("cpu", warnings.append) == "cpu"
    assert not warnings


def test_without_the_provider_the_cpu_is_used(warnings: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(onnxruntime, "get_available_providers", lambda: ["CPUExecutionProvider"])
    assert network_device("cuda", warnings.append) == "cpu"
    assert len(warnings) == 1
    assert "has no CUDA provider" in warnings[0]


@pytest.mark.parametrize("retries", [False, True])
def test_a_provider_that_does_not_load_gives_one_warning(
    retries: bool,
    warnings: list[str],
    with_provider: None,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    create = onnxruntime.InferenceSession._create_inference_session

    def fail(session: Any, providers: Any, *rest: Any) -> None:
        # onnxruntime retries by itself, with the same provider if it also has that of TensorRT.
        session._fallback_providers = ["CPUExecutionProvider"] if retries else providers
        if any(CUDA_PROVIDER in provider for provider in providers):
            raise RuntimeError("libcudnn.so.9: cannot open shared object file")
        create(session, providers, *rest)

    monkeypatch.setattr(onnxruntime.InferenceSession, "_create_inference_session", fail)
    assert network_device("cuda", warnings.append) == "cpu"
    assert len(warnings) == 1
    assert "does not load" in warnings[0]
    assert OnnxModel(model_file("embedded", "expert"), "cuda").device == "cpu"
    assert capsys.readouterr().out == ""  # stdout is for results


def test_a_provider_that_loads_is_used(
    warnings: list[str], with_provider: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(onnxruntime.InferenceSession, "get_providers", lambda session: [CUDA_PROVIDER])
    create = onnxruntime.InferenceSession._create_inference_session
    asked = []

    def keep(session: Any, providers: Any, *rest: Any) -> None:
        asked.append(providers)
        create(session, ["CPUExecutionProvider"], *rest)

    monkeypatch.setattr(onnxruntime.InferenceSession, "_create_inference_session", keep)
    assert network_device("cuda", warnings.append) == "cuda"
    assert not warnings
    (name, options), fallback = asked[0]
    assert (name, fallback) == (CUDA_PROVIDER, "CPUExecutionProvider")
    assert options["use_tf32"] == "0"
    assert OnnxModel(model_file("embedded", "expert"), "cuda").takes_batches
    asked.clear()
    OnnxModel(model_file("embedded", "expert"))
    assert asked == [["CPUExecutionProvider"]]


def items(count: int) -> list[Floats]:
    return [np.full((2, 3), number, np.float32) for number in range(count)]


def test_batches_keep_the_order_and_their_size() -> None:
    sizes = []

    def run(batch: Floats) -> Floats:
        sizes.append(len(batch))
        return -batch

    results = in_batches(run, items(10), 25)
    assert sizes == [4, 4, 2]
    assert [result[0, 0] for result in results] == [-number for number in range(10)]
    sizes.clear()
    in_batches(run, items(2), 5)
    assert sizes == [1, 1]


def test_a_batch_that_does_not_fit_is_halved() -> None:
    tried = []

    def run(batch: Floats) -> Floats:
        tried.append(len(batch))
        if len(batch) > 2:
            raise MemoryError("Failed to allocate memory for requested buffer of size 8589934592")
        return batch

    results = in_batches(run, items(5), 48)
    assert tried == [5, 2, 2, 1]
    assert [result[0, 0] for result in results] == list(range(5))


def test_failures_of_single_items_are_errors() -> None:
    def exhausted(batch: Floats) -> Floats:
        raise MemoryError("CUDA error: out of memory")

    def broken(batch: Floats) -> Floats:
        raise RuntimeError("invalid input name")

    with pytest.raises(StageError, match="does not hold") as caught:
        in_batches(exhausted, items(3))
    assert "--device cpu" in caught.value.hint
    with pytest.raises(RuntimeError, match="invalid input"):
        in_batches(broken, items(3))


def test_batches_restore_and_score_as_single_tiles_do(monkeypatch: pytest.MonkeyPatch) -> None:
    image = np.random.default_rng(0).random((64, 300, 3), np.float32)
    expert = OnnxExpert(model_file("embedded", "expert"))
    path = model_file(CLARITY, "scorer")
    assert path is not None
    scorer = LearnedScorer(path, CLARITY, 64)
    monkeypatch.setattr(tiling, "FREE_TILE", 128)
    single, score = expert.restore(image), scorer.score(image)
    monkeypatch.setattr(OnnxModel, "takes_batches", True)
    together = expert.restore(image)
    # The order of the sums in a convolution may differ in a batch.
    np.testing.assert_allclose(together, single, atol=1e-5)
    assert scorer.score(image) == pytest.approx(score, abs=1e-4)
