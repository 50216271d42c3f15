"""Settings and fixtures for all tests."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, settings

# Examples have no deadline, and drawing them may be slow, so that a busy machine causes no failure.
settings.register_profile("cleargs", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("cleargs")

# As in `cleargs.cli.entry`, since tests that run in parallel have more threads than cores.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")


TESTS = Path(__file__).parent
HEAVY = {
    "capture",
    "batch/test_batch.py",
    "cli/test_commands.py",
    "evaluate/test_eval_cli.py",
    "evaluate/test_evaluate.py",
    "formation/test_capture.py",
    "formation/test_measured.py",
    "formation/test_search.py",
    "formation/test_warp.py",
    "report/test_export_formats.py",
    "report/test_outputs.py",
    "rivr/test_groups.py",
    "rivr/test_stages.py",
    "splat/test_compressed_ply.py",
    "splat/test_determinism.py",
    "splat/test_formats.py",
    "splat/test_g0.py",
    "splat/test_rasteriser.py",
    "splat/test_sog.py",
    "splat/test_trainer.py",
    "synth/test_movers.py",
    "synth/test_native_video.py",
    "synth/test_phone.py",
    "test_api.py",
    "test_end_to_end.py",
    "test_examples.py",
    "test_fuzz.py",
    "test_gpu.py",
    "test_packaging.py",
    "test_planted_links.py",
    "test_subprocesses.py",
}
"""Folders and files that take more than three seconds of a processor: `make test-quick` leaves them out."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        place = item.path.relative_to(TESTS)
        if {place.as_posix(), place.parts[0]} & HEAVY:
            item.add_marker(pytest.mark.heavy)


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
