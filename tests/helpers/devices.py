"""The device of GPU kernels in tests: a GPU, or Triton's interpreter with tensors on the CPU."""

from __future__ import annotations

import importlib.util
import os

import pytest
import torch


def gpu(monkeypatch: pytest.MonkeyPatch) -> torch.device:
    """Return the device for a test's tensors, and let the test use the GPU kernels on it."""
    if importlib.util.find_spec("triton") is None:
        pytest.skip("needs Triton: pip install 'cleargs[cuda]'")
    if os.environ.get("TRITON_INTERPRET") == "1":
        from cleargs.splat.kernels.cuda import support

        monkeypatch.setattr(support, "on_gpu", lambda device: True)
        return torch.device("cpu")
    if not torch.cuda.is_available():
        pytest.skip("needs a GPU, or TRITON_INTERPRET=1 for Triton's interpreter")
    return torch.device("cuda")


@pytest.fixture(params=["cpu", pytest.param("cuda", marks=pytest.mark.gpu)])
def device(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> torch.device:
    """The device for a test's tensors. The test runs once per back end."""
    return gpu(monkeypatch) if request.param == "cuda" else torch.device("cpu")
