"""Settings and fixtures for all tests."""

from __future__ import annotations

import os
from collections.abc import Iterator
from typing import Any

import pytest
from hypothesis import HealthCheck, settings

# Examples have no deadline, and drawing them may be slow, so that a busy machine causes no failure.
settings.register_profile("cleargs", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("cleargs")

# As in `cleargs.cli.entry`, since tests that run in parallel have more threads than cores.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")


@pytest.fixture(autouse=True)
def hidden_gpu(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Hide the machine's GPU from all tests except those of the GPU: ``--device auto`` is the CPU."""
    if request.node.get_closest_marker("gpu") is None:
        monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "")


@pytest.fixture(scope="session")
def browser() -> Iterator[Any]:
    """One browser for all tests of pages, since Playwright refuses a second one in the same process."""
    from helpers.chromium import chromium

    with chromium() as opened:
        yield opened
