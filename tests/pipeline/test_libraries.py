"""Which libraries a key names: those that compute, by what was installed and where it runs."""

from __future__ import annotations

from importlib.metadata import PackageNotFoundError

import pytest

from cleargs.models import onnx
from cleargs.pipeline import keys
from cleargs.pipeline.dag import installed
from cleargs.pipeline.keys import library_versions


@pytest.fixture(autouse=True)
def known(monkeypatch: pytest.MonkeyPatch) -> dict[str, str]:
    """What is installed."""
    versions = {"onnxruntime-gpu": "1.31.0", "triton": "3.4.0"}

    def version(name: str) -> str:
        if name not in versions:
            raise PackageNotFoundError(name)
        return versions[name]

    monkeypatch.setattr(keys, "version", version)
    keys._onnxruntime.cache_clear()
    return versions


def test_onnxruntime_is_named_as_it_was_installed_and_runs(
    known: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert library_versions(("onnxruntime",), "cpu") == {"onnxruntime": "onnxruntime-gpu 1.31.0, on cpu"}
    monkeypatch.setattr(onnx, "network_device", lambda device, warn: "cuda")
    assert library_versions(("onnxruntime",), "cuda") == {"onnxruntime": "onnxruntime-gpu 1.31.0, on cuda"}
    keys._onnxruntime.cache_clear()
    monkeypatch.setattr(onnx, "network_device", lambda device, warn: "cpu")  # the provider does not load
    assert library_versions(("onnxruntime",), "cuda") == {"onnxruntime": "onnxruntime-gpu 1.31.0, on cpu"}
    keys._onnxruntime.cache_clear()
    known.clear()
    assert library_versions(("onnxruntime",), "cpu") == {"onnxruntime": "absent, on cpu"}


def test_triton_counts_on_a_gpu_only(known: dict[str, str]) -> None:
    assert library_versions(("triton", "torch"), "cpu") == {"torch": "absent"}
    assert library_versions(("triton", "torch"), "cuda") == {"triton": "3.4.0", "torch": "absent"}


def test_every_stage_that_trains_names_triton() -> None:
    for name in ("g0", "rivr", "consolidate"):
        assert "triton" in installed().load(name).LIBRARIES
