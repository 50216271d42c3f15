"""The tests of what only a GPU's back end has."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from helpers import devices


@pytest.fixture(autouse=True)
def device(monkeypatch: pytest.MonkeyPatch) -> torch.device:
    """The device of the test's tensors; every dispatch leads to the GPU's kernels."""
    return devices.gpu(monkeypatch)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark all of this folder."""
    for item in items:
        if Path(__file__).parent in item.path.parents:
            item.add_marker(pytest.mark.gpu)
