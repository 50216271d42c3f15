"""A run and `gc` are killed many times while both run: the results are those of an undisturbed run.

``CLEARGS_KILLS=50`` makes the test longer.
"""

from __future__ import annotations

import os
import random
import subprocess
import sys
import time

import pytest
from test_interruption import PROGRAM, start
from toy import Bench

KILLS = int(os.environ.get("CLEARGS_KILLS", "6"))


def collect(bench: Bench, *options: str) -> subprocess.Popen[str]:
    command = [sys.executable, PROGRAM, bench.journal, "gc", "--store", bench.store, "--yes", *options]
    return subprocess.Popen(
        [str(part) for part in command], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )


@pytest.mark.slow
def test_runs_and_collections_are_killed_at_any_moment(bench: Bench) -> None:
    healthy = bench.digests()
    bench.folder.rename(bench.root / "undisturbed")
    chance = random.Random(11)
    for number in range(KILLS):
        # Two variants, so that there are always results without a link.
        power = f"square.power={2 + number % 2}"
        processes = [start(bench, "square.delay_s=0.02", power)]
        if bench.store.is_dir():
            processes.append(collect(bench, *(["--checkpoints"] if number % 3 == 0 else [])))
        time.sleep(chance.uniform(0.1, 0.8))
        for process in processes:
            if chance.random() < 0.8:
                process.kill()
        for process in processes:
            _, errors = process.communicate(timeout=300)
            assert "unexpected" not in errors and "Traceback" not in errors, errors
    for power in ("square.power=3", "square.power=2"):
        process = start(bench, "square.delay_s=0.02", power)
        _, errors = process.communicate(timeout=300)
        assert process.returncode == 0, errors
    assert bench.digests() == healthy
    for name in bench.dag.names:
        assert (bench.folder / name).resolve().is_dir()
    gone = collect(bench)
    _, errors = gone.communicate(timeout=300)
    assert gone.returncode == 0, errors
    assert bench.digests() == healthy
