"""Device of networks in runs on a GPU, tested without a GPU."""

from __future__ import annotations

from typing import Any

import onnxruntime
import pytest

from cleargs.models.onnx import CUDA_PROVIDER, OnnxModel, network_device
from cleargs.models.registry import model_file


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
    assert OnnxModel(model_file("embedded", "expert"), "cuda").device == "cuda"
    asked.clear()
    OnnxModel(model_file("embedded", "expert"))
    assert asked == [["CPUExecutionProvider"]]
