"""The Snakefile and its profile, on this machine and on a real Slurm with stopped jobs and lost nodes."""

from __future__ import annotations

import json
import os
import shlex
import subprocess
import tempfile
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest
from slurm import DAEMONS, Slurm, program, running_slurm
from toy_batch import ToyBatch

ROOT = Path(__file__).parents[2]
WORKFLOWS = ROOT / "workflows"
SNAKEMAKE = ROOT / ".venv-cluster" / "bin" / "snakemake"
LACKING = [name for name in DAEMONS if program(name) is None]

needs_snakemake = pytest.mark.skipif(not SNAKEMAKE.exists(), reason="no Snakemake: make cluster")

IMPATIENT = """\
import asyncio
import sys
from snakemake.cli import main

sleep = asyncio.sleep
asyncio.sleep = lambda seconds: sleep(min(seconds, 0.5))
sys.exit(main())
"""
"""Snakemake that asks Slurm every half second. Its plugin would wait ten seconds longer after each time."""


def start(toys: ToyBatch, *arguments: str) -> subprocess.Popen[str]:
    """Start Snakemake on the toys' sheet."""
    (toys.root / "impatient.py").write_text(IMPATIENT)
    command = [str(SNAKEMAKE.with_name("python")), str(toys.root / "impatient.py")]
    command += ["--snakefile", str(WORKFLOWS / "Snakefile"), *arguments]
    command += ["--config", "sheet=sheet.toml", "options=--device cpu", f"cleargs={shlex.join(toys.program)}"]
    output = (toys.root / "snakemake.log").open("w")
    return subprocess.Popen(command, cwd=toys.root, stdout=output, stderr=output, text=True)


def finish(toys: ToyBatch, engine: subprocess.Popen[str], code: int) -> None:
    """Wait for the end of Snakemake, and check its exit code."""
    assert engine.wait(timeout=300) == code, (toys.root / "snakemake.log").read_text()[-4000:]


def test_all_workflow_files_are_installed() -> None:
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]
    patterns = settings["package-data"]["cleargs.workflows"]
    present = {file for file in WORKFLOWS.rglob("*") if file.is_file() and file.suffix not in (".py", ".pyc")}
    assert present == {file for pattern in patterns for file in WORKFLOWS.glob(pattern)}


@pytest.mark.slow
@pytest.mark.alone
@needs_snakemake
def test_a_bad_scene_does_not_stop_the_others(toys: ToyBatch) -> None:
    (toys.root / "barn" / "11.txt").write_text("no number")
    here = ("--cores", "1", "--keep-going", "--rerun-triggers", "mtime")
    finish(toys, start(toys, *here), 1)
    summary = toys.summary()
    assert {name: row["state"] for name, row in summary.items()} == {
        "attic": "done",
        "barn": "failed",
        "cellar": "done",
    }
    assert "no number" in summary["barn"]["cause"] and (toys.folder / "report" / "index.html").is_file()
    toys.work_done()
    (toys.root / "barn" / "11.txt").write_text("11")
    finish(toys, start(toys, *here), 0)
    assert [line for line in toys.work_done() if line in toys.dag.names] == ["count", "square", "total"]
    assert toys.digests("barn") == toys.undisturbed("barn")

    (toys.root / "sheet.toml").write_text('[[scene]]\nname = "attic"\ninput = "nowhere"')
    finish(toys, start(toys, *here), 1)
    cause = f"scene attic: {toys.root / 'nowhere'} does not exist"
    assert cause in (toys.root / "snakemake.log").read_text()


@pytest.fixture(scope="module")
def cluster() -> Iterator[Slurm]:
    # Not pytest's folder: the path of a Unix socket may have 107 characters.
    with tempfile.TemporaryDirectory(prefix="slurm-") as folder, running_slurm(Path(folder) / "s") as slurm:
        yield slurm


@pytest.fixture
def slurm(cluster: Slurm) -> Iterator[Slurm]:
    """The cluster, cleared after each test."""
    yield cluster
    cluster.clear()


@pytest.mark.slow
@pytest.mark.alone
@needs_snakemake
@pytest.mark.skipif(bool(LACKING), reason=f"Slurm is not installed: {', '.join(LACKING)}")
def test_time_limit_and_lost_node_cost_no_finished_work(toys: ToyBatch, slurm: Slurm) -> None:
    toys.write_sheet({"attic": "", "cellar": ""}, held=True)
    before = set(slurm.jobs())
    engine = start(toys, "--profile", str(WORKFLOWS / "profiles" / "slurm"))
    toys.wait_until(lambda: toys.lines().count("held") == 2, "both held", 100)
    warned, lost = sorted(set(slurm.jobs()) - before, key=int)
    asked = slurm("scontrol", "show", "job", warned)
    plan = json.loads((toys.folder / "plan.json").read_text())
    assert "MinMemoryNode=2000M" in asked and "NumCPUs=4" in asked
    assert plan["scenes"][0]["hours"] == pytest.approx(6.4 / 60, abs=0.001) and "TimeLimit=00:20:00" in asked
    slurm("scancel", "--signal=TERM", warned)  # like --signal before the limit
    toys.wait_until(
        lambda: slurm.jobs()[warned] not in ("RUNNING", "COMPLETING"), "the end of the warned job"
    )
    assert "interrupted" in "".join(log.read_text() for log in (toys.folder / "logs").iterdir())
    slurm("scontrol", "update", f"NodeName={slurm.node_of(lost)}", "State=DOWN", "Reason=test")
    toys.wait_until(lambda: "Restarts=1" in slurm("scontrol", "show", "job", lost), "the lost job back")
    toys.hold.unlink()
    for node in ("n1", "n2"):
        if "down" in slurm("sinfo", "--noheader", "--nodes", node, "--format", "%T"):
            slurm("scontrol", "update", f"NodeName={node}", "State=RESUME")
    finish(toys, engine, 0)
    assert len(set(slurm.jobs()) - before) == 3, "only the warned job was submitted again"
    lines = toys.lines()
    assert lines.count("square 0.txt") == lines.count("square 20.txt") == 1, "no checkpoint was used"
    for scene in ("attic", "cellar"):
        assert toys.summary()[scene]["state"] == "done"
        assert toys.digests(scene) == toys.undisturbed(scene)


def test_the_profile_warns_before_the_time_limit() -> None:
    profile = (WORKFLOWS / "profiles" / "slurm" / "config.yaml").read_text()
    assert "--signal=TERM@120" in profile


def test_the_profile_asks_squeue_where_jobs_are_forgotten_soon() -> None:
    """The plug-in asks sacct, which needs accounting, where MinJobAge is below three times these seconds."""
    lines = (WORKFLOWS / "profiles" / "slurm" / "config.yaml").read_text().splitlines()
    (seconds,) = (line.split()[1] for line in lines if line.startswith("slurm-init-seconds-before-status"))
    assert 3 * int(seconds) < 60 and "slurm-status-command: squeue" in "\n".join(lines)
    assert os.access(WORKFLOWS / "Snakefile", os.R_OK)
