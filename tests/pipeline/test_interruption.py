"""Real processes with the toy pipeline, which are killed or meet in the same folder."""

from __future__ import annotations

import os
import random
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from toy import Bench

from cleargs.manifest import read_manifest

PROGRAM = Path(__file__).with_name("toy.py")


def start(
    bench: Bench, *overrides: str, capture: Path | None = None, folder: Path | None = None
) -> subprocess.Popen[str]:
    recipe = bench.root / "empty.toml"
    recipe.touch()
    command = [sys.executable, PROGRAM, bench.journal, "run", capture or bench.capture]
    command += ["-o", folder or bench.folder, "--store", bench.store, "--workflow", recipe]
    command += [part for text in overrides for part in ("--set", text)]
    return subprocess.Popen(
        [str(part) for part in command], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )


def wait_for(bench: Bench, line: str) -> None:
    """Wait until the stages have noted ``line``."""
    deadline = time.monotonic() + 60
    while line not in (bench.journal.read_text() if bench.journal.exists() else ""):
        assert time.monotonic() < deadline, f"never saw {line!r}"
        time.sleep(0.005)


def test_killed_run_ends_with_the_same_digests(bench: Bench) -> None:
    undisturbed = bench.digests()
    (bench.folder).rename(bench.root / "undisturbed")
    bench.work_done()
    chance = random.Random(5)
    for moment in ("count\n", "count 4.txt", "square 0.txt", "square 3.txt", "total\n", ""):
        process = start(bench, "square.delay_s=0.02")
        if moment:
            wait_for(bench, moment)
            time.sleep(chance.uniform(0, 0.03))
        else:
            time.sleep(chance.uniform(0.2, 0.6))
        process.kill()
        process.communicate()
    process = start(bench, "square.delay_s=0.02")
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 0, errors
    done = bench.work_done()
    assert done.count("square 0.txt") <= 2, "the checkpoint was used"
    assert bench.digests() == undisturbed
    assert bench.work_done() == []
    assert not [path for path in bench.folder.rglob("*") if ".partial" in path.name]


@pytest.mark.parametrize("folder", ["run", "other"])
def test_two_runs_at_once_do_each_stage_once(bench: Bench, folder: str) -> None:
    (bench.root / "hold").touch()
    first = start(bench, f"square.hold={bench.root / 'hold'}")
    wait_for(bench, "held")
    second = start(bench, folder=bench.root / folder)
    assert second.stderr is not None
    what = "run" if folder == "run" else "square"
    met = any(line.startswith(f"{what}: process {first.pid} on ") for line in second.stderr)
    (bench.root / "hold").unlink()
    assert met
    for process in (first, second):
        _, errors = process.communicate(timeout=60)
        assert process.returncode == 0, errors
    done = bench.work_done()
    assert [done.count(stage) for stage in ("count", "square", "total")] == [1, 1, 1]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_interrupted_run_says_so_and_resumes(bench: Bench, number: signal.Signals) -> None:
    (bench.root / "hold").touch()
    process = start(bench, f"square.hold={bench.root / 'hold'}")
    wait_for(bench, "held")
    os.kill(process.pid, number)
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 130
    assert "same command" in errors and "Traceback" not in errors
    bench.work_done()
    (noted,) = (bench.store / "work").glob("*/seconds")
    clock, processor, compiling = map(float, noted.read_text().split())
    assert clock > 0.0 and processor > 0.0 and compiling == 0.0
    noted.write_text(f"{clock} 100 7")
    bench.run()
    assert "square 0.txt" not in bench.work_done()
    made = read_manifest(bench.folder / "square")
    assert made.seconds >= clock, "the time before the interruption counts"
    assert (made.cpu_seconds or 0) >= 100 and made.compile_seconds == 7, "and so do its parts"


def test_two_runs_of_different_inputs_in_one_folder(bench: Bench) -> None:
    other = bench.root / "other"
    shutil.copytree(bench.capture, other)
    (other / "5.txt").write_text("50")
    (bench.root / "hold").touch()
    first = start(bench, f"square.hold={bench.root / 'hold'}")
    wait_for(bench, "held")
    second = start(bench, capture=other)
    _, errors = second.communicate(timeout=60)
    assert second.returncode == 2 and "is a run of" in errors
    (bench.root / "hold").unlink()
    _, errors = first.communicate(timeout=60)
    assert first.returncode == 0, errors


def test_two_runs_of_different_settings_in_one_folder(bench: Bench) -> None:
    (bench.root / "hold").touch()
    first = start(bench, f"square.hold={bench.root / 'hold'}")
    wait_for(bench, "held")
    second = start(bench, "square.power=3")
    assert second.stderr is not None
    assert any("works on it; waiting" in line for line in second.stderr)
    assert "power = 2" in (bench.folder / "run.toml").read_text()
    (bench.root / "hold").unlink()
    for process in (first, second):
        _, errors = process.communicate(timeout=60)
        assert process.returncode == 0, errors
    assert (bench.folder / "square" / "powers" / "5.txt").read_text() == "125"
    assert "power = 3" in (bench.folder / "run.toml").read_text()
