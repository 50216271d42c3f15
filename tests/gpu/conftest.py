"""Tests of the GPU's back end."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from helpers import devices


@pytest.fixture(autouse=True)
def device(monkeypatch: pytest.MonkeyPatch) -> torch.device:
    """Return the device of the test's tensors. Every dispatch chooses the GPU's kernels."""
    return devices.gpu(monkeypatch)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark all of this folder."""
    for item in items:
        if Path(__file__).parent in item.path.parents:
            item.add_marker(pytest.mark.gpu)
