"""A key names the libraries that affect results on its device, with the installed versions."""

from __future__ import annotations

from importlib.metadata import PackageNotFoundError

import pytest

from cleargs import plugins
from cleargs.models import onnx
from cleargs.models.onnx import runtime_version
from cleargs.pipeline.keys import library_versions
from cleargs.pipeline.stages import installed


@pytest.fixture(autouse=True)
def known(monkeypatch: pytest.MonkeyPatch) -> dict[str, str]:
    """Replace the installed distributions."""
    versions = {"onnxruntime-gpu": "1.31.0", "triton": "3.4.0"}

    def version(name: str) -> str:
        if name not in versions:
            raise PackageNotFoundError(name)
        return versions[name]

    monkeypatch.setattr(plugins, "version", version)
    runtime_version.cache_clear()
    return versions


def test_onnxruntime_is_named_with_distribution_and_device(
    known: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert runtime_version("cpu") == "onnxruntime-gpu 1.31.0, on cpu"
    monkeypatch.setattr(onnx, "network_device", lambda device, warn: "cuda")
    assert runtime_version("cuda") == "onnxruntime-gpu 1.31.0, on cuda"
    runtime_version.cache_clear()
    monkeypatch.setattr(onnx, "network_device", lambda device, warn: "cpu")  # the provider does not load
    assert runtime_version("cuda") == "onnxruntime-gpu 1.31.0, on cpu"
    runtime_version.cache_clear()
    known.clear()
    assert runtime_version("cpu") == "absent, on cpu"


@pytest.mark.parametrize("name", ["g0", "rivr", "consolidate"])
def test_triton_counts_on_a_gpu_only(monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    monkeypatch.setattr(onnx, "network_device", lambda device, warn: "cpu")
    stage = installed().load(name)
    on_cpu, on_gpu = (library_versions(stage, device, stage.CONFIG()) for device in ("cpu", "cuda"))
    assert set(on_gpu) - set(on_cpu) == {"triton"} and on_gpu["triton"] == "3.4.0"
    assert on_cpu["torch"] == "absent" and ("onnxruntime" in on_cpu) == (name != "g0")
