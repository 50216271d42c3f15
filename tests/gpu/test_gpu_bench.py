"""The benchmark of a GPU at toy size: its tables, and its errors, which do not depend on the device."""

from __future__ import annotations

import importlib
import json

import pytest

from benchmarks.speed.benchmark_plan import BenchmarkCase, DevicePlan
from cleargs.progress import SilentReporter

SMALL, LARGE = BenchmarkCase(6, 15, 12), BenchmarkCase(9, 16, 14)


@pytest.fixture
def bench(device):
    """The benchmark, imported here because it imports Triton."""
    return importlib.import_module("benchmarks.speed.device")


def test_every_row_has_times_and_errors(device, bench):
    plan = DevicePlan((SMALL, LARGE), rounds=1, repetitions=1, seed=4)
    first, found = bench.run(plan, device, SilentReporter())
    assert len(first.rows) == 1
    for row, case in zip(found.rows, plan.cases, strict=True):
        assert row.case == case
        assert 0 < row.ours.accuracy.image.max < 1e-5
        assert 0 < row.ours.accuracy.worst_gradient < 1e-4
        assert set(row.ours.times) == {"forward", "loss", "backward", "adam", "iteration"}
    assert found.rows[0].pairs >= found.rows[0].reached > 0
    text = importlib.import_module("benchmarks.speed.device_markdown").device_markdown(found)
    assert f"{found.rows[1].ours.accuracy.image.max:.1e}" in text
    for table in text.split("\n\n"):
        if table.startswith("|"):
            assert len({line.count("|") for line in table.splitlines()}) == 1
    again = json.loads(json.dumps(found.as_json()))
    assert again["rows"][1]["case"]["gaussians"] == LARGE.gaussians
