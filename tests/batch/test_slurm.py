"""Batches on a real Slurm: what dies is taken up again, and nothing is lost."""

from __future__ import annotations

import os
import re
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

from cleargs.batch.folder import BatchFolder
from cleargs.batch.snakemake import ENGINE_VARIABLE, find_snakemake, profile_folder
from cleargs.manifest import read_manifest
from cleargs.pipeline.dag import installed

pytestmark = [
    pytest.mark.slow,
    pytest.mark.usefixtures("impatient_engine"),
    pytest.mark.skipif(missing_daemon() is not None, reason=f"Slurm's {missing_daemon()} is not installed"),
]


@pytest.fixture(scope="module")
def cluster() -> Iterator[Slurm]:
    # Not pytest's folder: the path of a Unix socket may have 107 characters.
    with tempfile.TemporaryDirectory(prefix="slurm-") as folder, running_slurm(Path(folder) / "s") as slurm:
        yield slurm


@pytest.fixture
def slurm(cluster: Slurm) -> Iterator[Slurm]:
    """The cluster, empty and whole again behind each test."""
    yield cluster
    cluster.clear()


IMPATIENT = """\
import asyncio
import sys
from snakemake.cli import main

sleep = asyncio.sleep
asyncio.sleep = lambda seconds: sleep(min(seconds, 0.5))
sys.exit(main())
"""


@pytest.fixture
def impatient_engine(engine: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Snakemake, but that it asks Slurm twice a second: its plugin waits ten seconds longer each time."""
    program = tmp_path / "impatient" / "snakemake"
    program.parent.mkdir()
    program.write_text(f"#!{find_snakemake().with_name('python')}\n{IMPATIENT}")
    program.chmod(0o755)
    monkeypatch.setenv(ENGINE_VARIABLE, str(program))


def make_profile(folder: Path, groups: str, *, retries: int = 0) -> str:
    """The profile that comes with ClearGS, with other ``groups``."""
    text = (profile_folder("slurm") / "config.yaml").read_text()
    for shipped, here in {
        "[rva=scene, g0=scene, rivr=scene, consolidate=scene]": groups,
        "retries: 1": f"retries: {retries}",
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


def kill_engine(toy: ToyBatch, batch: subprocess.Popen[str]) -> None:
    """As when the login node dies: the command and Snakemake are gone, the jobs are not."""
    os.killpg(batch.pid, signal.SIGKILL)
    batch.communicate()
    os.killpg(toy.engine, signal.SIGKILL)


def test_the_controllers_die_and_a_second_batch_goes_on(toy: ToyBatch, slurm: Slurm) -> None:
    """Snakemake and slurmctld are killed at once; meanwhile the jobs go on."""
    profile = make_profile(toy.root, "[count=scene, square=scene, total=scene]")
    toy.write_sheet(toy.held(), scenes={"attic": "", "barn": ""})
    bad = toy.capture("barn")
    for file in bad.iterdir():
        file.unlink()
    bad.rmdir()
    bad.write_text("no capture")  # count, the toys' ingest, wants a folder
    first = toy.start(profile, start_new_session=True)
    toy.wait_for("held")
    job, _ = job_of(toy, "attic", "square")
    second = toy.start(profile)
    _, errors = second.communicate(timeout=60)
    assert second.returncode == 1 and "at work already" in errors

    toy.wait_until(lambda: list(all_jobs(slurm).values()).count("RUNNING") == 1, "the end of barn's job")
    kill_engine(toy, first)
    slurm.restart_controller()
    third = toy.start(profile)
    toy.hold.unlink()
    code, scenes = finish(third)
    assert code == 1, toy.engine_said()
    slurm.wait_until(f"job {job}", "JobState=COMPLETED")
    kinds = {name: state["state"] for name, state in scenes.items()}
    assert kinds == {"attic": "done", "barn": "failed"}, toy.engine_said()
    assert (scenes["barn"]["stage"], scenes["barn"]["cause"]) == ("count", "the capture is no folder")
    work = toy.work_done()
    assert work.count("square 0.txt") == work.count("square 5.txt") == 1, work
    assert toy.digests("attic") == toy.undisturbed("attic")


GPUS = """\
[resources.square]
gpus = 1
[resources.total]
gpus = 1
"""
"""Each node has one GPU: two scenes cannot be at work on the same one."""


def test_a_node_goes_down_and_a_time_limit_comes(toy: ToyBatch, slurm: Slurm) -> None:
    profile = make_profile(toy.root, "[square=scene, total=scene]")
    toy.write_sheet(f"{toy.held()}square.delay_s = 1\n{GPUS}", scenes={"attic": "", "cellar": ""})
    batch = toy.start(profile)
    toy.wait_until(lambda: toy.lines().count("held") == 2, "both held")
    job, node = job_of(toy, "attic", "square")
    warned, other = job_of(toy, "cellar", "square")
    assert node != other and job != warned
    slurm("scancel", "--signal=TERM", warned)  # as --signal does before the limit
    slurm("scontrol", "update", f"NodeName={node}", "State=DOWN", "Reason=test")
    slurm.wait_until(f"job {job}", "Restarts=1")
    toy.hold.unlink()  # the warned job gets to its next checkpoint, and ends there
    slurm.wait_until(f"job {warned}", "Restarts=1")
    slurm("scontrol", "update", f"NodeName={node}", "State=RESUME")
    code, _ = finish(batch)
    assert code == 0, toy.engine_said()
    work = toy.work_done()
    assert work.count("square 0.txt") == work.count("square 20.txt") == 1, work
    for scene, group in (("attic", job), ("cellar", warned)):
        assert toy.digests(scene) == toy.undisturbed(scene)
        assert {stage: jobs_of(toy, scene)[stage] == group for stage in toy.dag.names} == {
            "count": False,
            "square": True,
            "total": True,
        }
        assert asked_gpus(slurm, group) == 1
        assert asked_gpus(slurm, jobs_of(toy, scene)["count"]) == 0


def test_ctrl_c_takes_back_the_jobs(toy: ToyBatch, slurm: Slurm) -> None:
    """One scene is at work, the other waits for the GPU."""
    profile = make_profile(toy.root, "[count=scene, square=scene, total=scene]")
    toy.write_sheet(toy.held() + GPUS, scenes={"attic": "", "barn": ""})
    slurm("scontrol", "update", "NodeName=n2", "State=DRAIN", "Reason=test")
    before = set(all_jobs(slurm))
    batch = toy.start(profile)
    toy.wait_for("held")
    toy.wait_until(lambda: len(all_jobs(slurm).keys() - before) == 2, "two jobs")
    batch.send_signal(signal.SIGINT)
    _, errors = batch.communicate(timeout=60)
    assert batch.returncode == 130, errors
    toy.wait_until(lambda: not slurm("squeue", "--noheader"), "an empty queue")
    ended = {job: state for job, state in all_jobs(slurm).items() if job not in before}
    assert list(ended.values()) == ["CANCELLED", "CANCELLED"], ended
    done = {
        (scene, stage) for scene in ("attic", "barn") for stage in toy.dag.names if toy.finished(scene, stage)
    }
    assert len(done) == 1 and {stage for _, stage in done} == {"count"}
    assert not list((toy.folder.store / "square").glob("*/manifest.json"))

    slurm("scontrol", "update", "NodeName=n2", "State=RESUME")
    toy.hold.unlink()
    code, scenes = toy.run(profile)
    assert code == 0, toy.engine_said()
    assert {state["state"] for state in scenes.values()} == {"done"}
    squares = toy.squares()
    assert len(squares) == len(set(squares)) == 12, f"no checkpoint was used: {squares}"
    for scene in ("attic", "barn"):
        assert toy.digests(scene) == toy.undisturbed(scene)


def jobs_of(toy: ToyBatch, scene: str) -> dict[str, str]:
    """Stage -> the Slurm job that did it."""
    found = {stage: toy.folder.read_status(scene, stage) for stage in toy.dag.names}
    return {stage: status.job for stage, status in found.items() if status is not None}


def asked_gpus(slurm: Slurm, job: str) -> int:
    """How many GPUs a job asked for."""
    found = re.search(r"gres:gpu:(\d+)", slurm("scontrol", "show", "job", job))
    return int(found[1]) if found else 0


def all_jobs(slurm: Slurm) -> dict[str, str]:
    """Every job that Slurm remembers, also those that ended -> its state."""
    lines = slurm("squeue", "--noheader", "--states", "all", "--Format", "JobID,State").splitlines()
    return dict(line.split() for line in lines)


SHEET = """\
recipe = "smoke"
[set]
g0.steps = 200
g0.min_points = 500
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
name = "hall-short"
input = "hall"
set.consolidate.distil.steps = 5
"""


def test_three_scenes_and_a_job_killed_amid_g0(tmp_path: Path, slurm: Slurm) -> None:
    """Two captures, one of them with two settings: their jobs share what they have in common."""
    for seed, name in enumerate(("kitchen", "hall")):
        cleargs("synth", str(tmp_path / name), "--frames", "8", "--size", "64x48", "--seed", str(seed))
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
    (key,) = {checkpoint.parents[1].name for checkpoint in checkpoints}
    writer = (folder.store / "locks" / f"{key}.lock").read_text()
    os.kill(int(writer.split()[1]), signal.SIGKILL)
    code, scenes = finish(batch)
    assert code == 0, folder.engine_log.read_text()[-3000:]
    assert {name: state["state"] for name, state in scenes.items()} == dict.fromkeys(
        ("kitchen", "hall", "hall-short"), "done"
    )
    assert "resuming from step" in log.read_text()
    made = {stage: len(list((folder.store / stage).iterdir())) for stage in STAGES}
    assert made == {"ingest": 2, "rva": 2, "g0": 2, "rivr": 2, "consolidate": 3}
    settings = SHEET.partition("[set]")[2].partition("[resources]")[0].split("\n")
    override = [word for line in settings if line for word in ("--set", line.replace(" ", ""))]
    undisturbed = tmp_path / "undisturbed"
    cleargs("run", str(tmp_path / "kitchen"), "-o", str(undisturbed), "--workflow", "smoke", *override)
    for stage in STAGES:
        mine = read_manifest(folder.run("kitchen") / stage).digest
        assert mine == read_manifest(undisturbed / stage).digest, stage


STAGES = installed().names
CLEARGS = (str(Path(sys.executable).with_name("cleargs")),)


def cleargs(*arguments: str) -> None:
    done = subprocess.run([*CLEARGS, *arguments], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def checkpoints_of(folder: BatchFolder, scene: str, stage: str) -> list[Path]:
    """Checkpoint files of the process that works on ``stage`` now."""
    status = folder.read_status(scene, stage)
    if status is None or status.state != "running":
        return []
    locks = (folder.store / "locks").glob("*.lock")
    keys = [lock.stem for lock in locks if f"Slurm job {status.job})" in lock.read_text()]
    return [
        file
        for key in keys
        for file in (folder.store / "work").glob(f"{key}/checkpoints/{stage}.safetensors")
    ]
