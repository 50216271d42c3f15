"""Where the GPU kernels run in these tests: on the device, or in Triton's interpreter on CPU tensors."""

from __future__ import annotations

import importlib.util
import os
import sys
from pathlib import Path
from typing import Any

import pytest
import torch

from cleargs.splat.camera import Camera
from cleargs.splat.gaussians import Gaussians

TESTS = Path(__file__).parent.parent
sys.path[:0] = [str(TESTS / "splat"), str(TESTS / "formation")]  # splat_scenes, splat_toy; warp_oracle


@pytest.fixture(autouse=True)
def device(monkeypatch: pytest.MonkeyPatch) -> torch.device:
    """The device of the test's tensors; from here on every dispatch leads to the GPU kernels."""
    if importlib.util.find_spec("triton") is None:
        pytest.skip("needs Triton: pip install 'cleargs[cuda]'")
    if os.environ.get("TRITON_INTERPRET") == "1":
        from cleargs.splat.kernels.cuda import support

        monkeypatch.setattr(support, "on_gpu", lambda device: True)
        return torch.device("cpu")
    if not torch.cuda.is_available():
        pytest.skip("needs a GPU, or TRITON_INTERPRET=1 for Triton's interpreter")
    return torch.device("cuda")


@pytest.fixture
def compare_on_device(monkeypatch: pytest.MonkeyPatch, device: torch.device) -> None:
    """``splat_scenes.compare`` makes its scene on the CPU: take it to the device and the pictures back."""
    import splat_scenes

    from cleargs.splat.render import render
    from cleargs.splat.types import Render

    def on_device(gaussians: Gaussians, camera: Camera, **settings: Any) -> Render:
        outputs = render(gaussians.to(device), camera, **settings)
        return Render(*(output.cpu() for output in outputs))

    monkeypatch.setattr(splat_scenes, "render", on_device)
