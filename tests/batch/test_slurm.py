"""Batches on a real Slurm: what dies is taken up again, and nothing is lost."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from slurm import Slurm, missing_daemon, running_slurm
from toy_batch import ToyBatch, finish

from cleargs.batch.engine import profile_folder
from cleargs.batch.folder import BatchFolder
from cleargs.pipeline.manifest import read_manifest

pytestmark = [
    pytest.mark.usefixtures("engine"),
    pytest.mark.skipif(missing_daemon() is not None, reason=f"Slurm's {missing_daemon()} is not installed"),
]


@pytest.fixture(scope="module")
def slurm() -> Iterator[Slurm]:
    # Not pytest's folder: the path of a Unix socket may have 107 characters.
    with tempfile.TemporaryDirectory(prefix="slurm-") as folder, running_slurm(Path(folder) / "s") as slurm:
        yield slurm


def make_profile(folder: Path, groups: str, *, retries: int = 0) -> str:
    """The profile that comes with ClearGS, impatient, with other ``groups``."""
    text = (
        profile_folder("slurm") / "config.yaml"
    ).read_text() + "slurm-init-seconds-before-status-checks: 1\n"
    for shipped, here in {
        "[rva=scene, g0=scene, rivr=scene, consolidate=scene]": groups,
        "retries: 1": f"retries: {retries}",
        "latency-wait: 60": "latency-wait: 10",
    }.items():
        assert shipped in text
        text = text.replace(shipped, here)
    (folder / "profile").mkdir()
    (folder / "profile" / "config.yaml").write_text(text)
    return str(folder / "profile")


def job_of(toy: ToyBatch, scene: str, stage: str) -> tuple[str, str]:
    """Slurm job and node of a stage at work."""
    status = toy.folder.read_status(scene, stage)
    assert status is not None and status.state == "running"
    return status.job, status.node


def kill_controller(toy: ToyBatch, batch: subprocess.Popen[str]) -> None:
    """As when the login node dies: the command and Snakemake are gone, the jobs are not."""
    os.killpg(batch.pid, signal.SIGKILL)
    batch.communicate()
    os.killpg(toy.engine, signal.SIGKILL)


def test_the_controller_dies_and_a_second_one_goes_on(toy: ToyBatch, slurm: Slurm) -> None:
    profile = make_profile(toy.root, "[count=scene, square=scene, total=scene]")
    toy.write_sheet("[set]\nsquare.delay_s = 1", scenes={"attic": "", "barn": "", "cellar": ""})
    bad = toy.capture("barn")
    for file in bad.iterdir():
        file.unlink()
    bad.rmdir()
    bad.write_text("no capture")  # count, the toys' ingest, wants a folder
    first = toy.start(profile, start_new_session=True)
    toy.wait_for("square 1.txt")
    second = toy.start(profile)
    _, errors = second.communicate(timeout=60)
    assert second.returncode == 1 and "at work already" in errors

    kill_controller(toy, first)
    code, scenes = finish(toy.start(profile))
    assert code == 1, toy.engine_said()
    assert {name: state["state"] for name, state in scenes.items()} == {
        "attic": "done",
        "barn": "failed",
        "cellar": "done",
    }, toy.engine_said()
    assert (scenes["barn"]["stage"], scenes["barn"]["cause"]) == ("count", "the capture is no folder")
    work = toy.work_done()
    assert work.count("square 1.txt") == 1, work
    for scene in ("attic", "cellar"):
        assert toy.digests(scene) == toy.undisturbed(scene)


def test_a_node_goes_down_and_a_time_limit_comes(toy: ToyBatch, slurm: Slurm) -> None:
    profile = make_profile(toy.root, "[square=scene, total=scene]")
    toy.write_sheet("[set]\nsquare.delay_s = 1", scenes={"attic": "", "cellar": ""})
    batch = toy.start(profile)
    toy.wait_for("square 1.txt")
    toy.wait_for("square 21.txt")
    job, node = job_of(toy, "attic", "square")
    warned, other = job_of(toy, "cellar", "square")
    assert node != other or job != warned
    slurm("scontrol", "update", f"NodeName={node}", "State=DOWN", "Reason=test")
    if other != node:
        slurm("scancel", "--signal=TERM", warned)  # as --signal does before the limit
    slurm.wait_until(f"job {job}", "Restarts=1")
    slurm("scontrol", "update", f"NodeName={node}", "State=RESUME")
    code, _ = finish(batch)
    assert code == 0, toy.engine_said()
    work = toy.work_done()
    assert work.count("square 0.txt") == work.count("square 20.txt") == 1, work
    assert "Restarts=1" in slurm("scontrol", "show", "job", warned)
    for scene in ("attic", "cellar"):
        assert toy.digests(scene) == toy.undisturbed(scene)


SHEET = """\
recipe = "smoke"
[set]
g0.steps = 150
g0.checkpoint_interval = 10
rivr.distil.steps = 10
consolidate.distil.steps = 10
[resources]
ingest.cpus = 1
rva.cpus = 1
g0.cpus = 1
rivr.cpus = 1
consolidate.cpus = 1

[[scene]]
name = "kitchen"
input = "kitchen"
[[scene]]
name = "hall"
input = "hall"
resources.g0.gpus = 1
[[scene]]
name = "hall-coarse"
input = "hall"
set.g0.steps = 60
"""


def test_three_scenes_and_a_job_killed_amid_g0(tmp_path: Path, slurm: Slurm) -> None:
    """Two captures, one of them with two settings: their jobs share what they have in common."""
    for seed, name in enumerate(("kitchen", "hall")):
        cleargs("synth", str(tmp_path / name), "--frames", "8", "--size", "96x64", "--seed", str(seed))
    (tmp_path / "sheet.toml").write_text(SHEET)
    groups = "[ingest=scene, rva=scene, g0=scene, rivr=scene, consolidate=scene]"
    profile = make_profile(tmp_path, groups, retries=1)
    folder = BatchFolder(tmp_path / "sheet.batch")
    batch = subprocess.Popen(
        [*CLEARGS, "batch", str(tmp_path / "sheet.toml"), "--profile", profile, "--json"],
        stdout=subprocess.PIPE,
        text=True,
    )
    log = folder.log("kitchen", "g0")
    deadline = time.monotonic() + 400
    while not (checkpoints := checkpoints_of(folder, "kitchen", "g0")):
        assert time.monotonic() < deadline and batch.poll() is None, folder.engine_log.read_text()[-3000:]
        time.sleep(0.05)
    (writer,) = {checkpoint.parents[1].name.partition("@")[2] for checkpoint in checkpoints}
    lease = json.loads((folder.store / "leases" / f"{writer}.json").read_text())
    os.kill(lease["pid"], signal.SIGKILL)
    code, scenes = finish(batch)
    assert code == 0, folder.engine_log.read_text()[-3000:]
    assert {name: state["state"] for name, state in scenes.items()} == dict.fromkeys(
        ("kitchen", "hall", "hall-coarse"), "done"
    )
    assert "going on from step" in log.read_text()
    assert len(list((folder.store / "ingest").iterdir())) == 2
    assert len(list((folder.store / "g0").iterdir())) == 3
    cleargs(
        *("run", str(tmp_path / "kitchen"), "-o", str(tmp_path / "undisturbed"), "--workflow", "smoke"),
        *("--set", "g0.steps=150", "--set", "rivr.distil.steps=10", "--set", "consolidate.distil.steps=10"),
    )
    for stage in ("ingest", "rva", "g0", "rivr", "consolidate"):
        mine = read_manifest(folder.run("kitchen") / stage).digest
        assert mine == read_manifest(tmp_path / "undisturbed" / stage).digest, stage


CLEARGS = (str(Path(sys.executable).with_name("cleargs")),)


def cleargs(*arguments: str) -> None:
    done = subprocess.run([*CLEARGS, *arguments], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def checkpoints_of(folder: BatchFolder, scene: str, stage: str) -> list[Path]:
    """Checkpoint files of the process that works on ``stage`` now."""
    status = folder.read_status(scene, stage)
    if status is None or status.state != "running":
        return []
    writers = [path for path in (folder.store / "leases").glob("*.json") if job_number(path) == status.job]
    return [
        file
        for writer in writers
        for file in (folder.store / "work").glob(f"*@{writer.stem}/checkpoints/{stage}.safetensors")
    ]


def job_number(path: Path) -> str:
    """The Slurm job in a lease."""
    try:
        return str(json.loads(path.read_text())["job"])
    except (OSError, ValueError):
        return ""
