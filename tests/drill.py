"""All five stages and ``gc`` killed again and again; the results are those of an undisturbed run.

``python tests/drill.py --kills 50`` works on a synthetic capture of eight tiny frames. Each
stage and ``gc`` get an equal share of the kills, SIGKILL at a random moment of their work; every third time
``gc`` is started beside a stage. Programs are forked from one that has everything imported, so that a kill
costs no start of Python.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import shutil
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from signal import SIGKILL

from cleargs.cli.main import main as cleargs
from cleargs.stages import STAGES

SETTINGS = {
    "g0.steps": 60,
    "g0.budget": 800,
    "g0.min_points": 400,
    "g0.checkpoint_interval": 10,
    "rivr.rounds": 2,
    "rivr.distil.steps": 20,
    "consolidate.distil.steps": 20,
}
HEAVY = ("torch", "numba", "pyarrow.parquet", "cv2", "OpenImageIO", "onnxruntime", "scipy.ndimage")
MAX_SECONDS = 3600.0
"""When a program counts as hung: far beyond what a busy machine needs."""


@dataclass
class Drill:
    """What is killed, and how often it was."""

    root: Path
    chance: random.Random
    kills: dict[str, int] = field(default_factory=lambda: dict.fromkeys((*STAGES, "gc"), 0))

    @property
    def run_folder(self) -> Path:
        return self.root / "run"

    def run(self, folder: Path, *more: str) -> Program:
        settings = [part for name, value in SETTINGS.items() for part in ("--set", f"{name}={value}")]
        arguments = ["run", str(self.root / "capture"), "-o", str(folder), "--workflow", "smoke"]
        return Program([*arguments, "--no-report", "--threads", "1", *settings, *more], self.root / "log")

    def collect(self, *more: str) -> Program:
        arguments = ["gc", "--store", str(self.run_folder / ".store"), *more]
        return Program(arguments, self.root / "gc.log")

    def kill_stage(self, stage: str, seconds: float) -> float:
        """One kill inside ``stage``, within ``seconds`` of its start; returns within which time next.

        Where it was faster than that, its result is taken away, so that there is work again.
        """
        program = self.run(self.run_folder, "--until", stage)
        program.wait_for(f"{stage}: started")
        time.sleep(self.chance.uniform(0, seconds))
        if self.kills[stage] % 3 == 0:
            beside = self.collect()  # refused while the stage is at work, whatever becomes of it afterwards
            self.kills[stage] += program.kill()
            beside.wait_for_end()
        else:
            self.kills[stage] += program.kill()
        if not (self.run_folder / stage).is_symlink():
            return 1.2 * seconds
        (self.run_folder / stage).unlink()
        self.collect().succeed()
        return 0.7 * seconds

    def kill_gc(self, seconds: float) -> None:
        """One kill inside a ``gc`` that has as much to remove as the run shows."""
        self.plant_garbage()
        program = self.collect(*(["--checkpoints"] if self.kills["gc"] % 2 else []))
        time.sleep(self.chance.uniform(0, seconds))
        self.kills["gc"] += program.kill()

    def plant_garbage(self) -> None:
        """Results that no run links to: those of the run under other keys."""
        for stage in STAGES:
            shown = (self.run_folder / stage).resolve()
            shutil.copytree(shown, shown.with_name(f"{self.chance.getrandbits(256):064x}"))


class Program:
    """``cleargs ARGUMENTS...`` in a process of its own, which leads its group."""

    def __init__(self, arguments: Sequence[str], log: Path) -> None:
        self.arguments, self.log = list(arguments), log
        log.write_bytes(b"")
        self.pid = os.fork()
        if self.pid == 0:
            os.setsid()
            handle = os.open(log, os.O_WRONLY | os.O_APPEND)
            os.dup2(handle, 1)
            os.dup2(handle, 2)
            try:
                cleargs(self.arguments)
            except SystemExit as end:
                os._exit(int(end.code or 0))
            os._exit(1)
        self.code: int | None = None

    def ended(self) -> bool:
        if self.code is None:
            pid, status = os.waitpid(self.pid, os.WNOHANG)
            if pid:
                self.code = os.waitstatus_to_exitcode(status)
        return self.code is not None

    def wait_for(self, line: str) -> None:
        """Until the program says ``line``, or ends. Raises TimeoutError when it does neither for an hour."""
        deadline = time.monotonic() + MAX_SECONDS
        while not self.ended() and line not in self.log.read_text():
            if time.monotonic() > deadline:
                raise TimeoutError(f"{self.arguments} never said {line!r}")
            time.sleep(0.01)

    def kill(self) -> bool:
        """SIGKILL to the program alone: its children have to notice. False when it had ended before."""
        alive = not self.ended()
        if alive:
            os.kill(self.pid, SIGKILL)
            self.code = os.waitstatus_to_exitcode(os.waitpid(self.pid, 0)[1])
        said = self.log.read_text()
        if "unexpected" in said or "Traceback" in said:
            raise AssertionError(f"{self.arguments} said:\n{said}")
        return alive and self.code == -SIGKILL

    def wait_for_end(self) -> None:
        self.wait_for("\0")

    def succeed(self) -> None:
        """Wait for its end. Raises AssertionError when it fails."""
        self.wait_for_end()
        if self.code:
            raise AssertionError(f"{self.arguments} ended with {self.code}:\n{self.log.read_text()}")


def digests(run: Path) -> dict[str, dict[str, str]]:
    """Stage -> file -> digest, as its manifest has them."""
    manifests = {stage: json.loads((run / stage / "manifest.json").read_bytes()) for stage in STAGES}
    return {
        stage: {name: record["digest"] for name, record in manifest["files"].items()}
        for stage, manifest in manifests.items()
    }


def drill(root: Path, kills: int, seed: int) -> dict[str, int]:
    """Kill, finish, compare; returns how often each program was killed at work.

    Raises AssertionError when the results differ, or a program ends as it must not.
    """
    for module in (*HEAVY, *(f"cleargs.stages.{stage}" for stage in STAGES)):
        import_module(module)
    this = Drill(root, random.Random(seed))
    synth = ["synth", str(root / "capture"), "--protocol", "mixed", "--frames", "8", "--size", "96x54"]
    Program(synth, root / "log").succeed()  # in a process of its own: whoever forks must have no threads
    this.run(root / "undisturbed").succeed()
    healthy = digests(root / "undisturbed")
    shares = {name: kills // 6 + (number < kills % 6) for number, name in enumerate(this.kills)}
    for stage in STAGES:
        seconds = json.loads((root / "undisturbed" / stage / "manifest.json").read_bytes())["seconds"]
        while this.kills[stage] < shares[stage]:
            seconds = this.kill_stage(stage, seconds)
        this.run(this.run_folder, "--until", stage).succeed()
        print(f"{stage}: {this.kills[stage]} kills", flush=True)
    assert digests(this.run_folder) == healthy, "the results differ from those of the undisturbed run"
    this.plant_garbage()
    started = time.monotonic()
    this.collect().succeed()
    seconds = time.monotonic() - started
    while this.kills["gc"] < shares["gc"]:
        this.kill_gc(seconds)
    print(f"gc: {this.kills['gc']} kills", flush=True)
    this.run(this.run_folder).succeed()
    this.collect().succeed()
    for stage in STAGES:
        left = [folder.name for folder in (this.run_folder / ".store" / stage).iterdir()]
        assert left == [(this.run_folder / stage).resolve().name], f"gc left {left}"
    Program(["verify", str(this.run_folder)], root / "log").succeed()
    assert digests(this.run_folder) == healthy, "gc took something that the run shows"
    return this.kills


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    root = Path(tempfile.mkdtemp(prefix="cleargs-drill-"))
    print(f"in {root}", flush=True)
    kills = drill(root, options.kills, options.seed)
    shutil.rmtree(root)
    print(f"killed {kills}; the digests are those of an undisturbed run")


if __name__ == "__main__":
    main()
