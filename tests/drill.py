"""Kill all five stages and ``gc`` many times, and check that the results are those of an undisturbed run.

``python tests/drill.py --kills 50`` uses a synthetic capture of eight tiny frames. The kills are divided
equally among the stages and ``gc``. Each is a SIGKILL at a random moment, every second one also to the
children of the program. For every third kill, ``gc`` runs at the same time as the stage. The undisturbed run
has two threads, and the others have one. Programs are forked from a process that has done all imports, which
saves time.
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
"""Time after which a program counts as hung, far longer than a busy machine needs."""


@dataclass
class Drill:
    """The run that is killed, and the number of kills per program."""

    root: Path
    chance: random.Random
    kills: dict[str, int] = field(default_factory=lambda: dict.fromkeys((*STAGES, "gc"), 0))

    @property
    def run_folder(self) -> Path:
        return self.root / "run"

    def run(self, folder: Path, *more: str, threads: int = 1) -> Program:
        settings = [part for name, value in SETTINGS.items() for part in ("--set", f"{name}={value}")]
        arguments = ["run", str(self.root / "capture"), "-o", str(folder), "--workflow", "smoke"]
        return Program(
            [*arguments, "--no-report", "--threads", str(threads), *settings, *more], self.root / "log"
        )

    def collect(self, *more: str) -> Program:
        arguments = ["gc", "--yes", "--store", str(self.run_folder / ".store"), *more]
        return Program(arguments, self.root / "gc.log")

    def kill_stage(self, stage: str, seconds: float) -> float:
        """Kill ``stage`` within ``seconds`` of its start, and return the time limit for the next kill.

        If the stage finished earlier, its result is deleted, so that it runs again.
        """
        program = self.run(self.run_folder, "--until", stage)
        program.wait_for(f"{stage}: started")
        time.sleep(self.chance.uniform(0, seconds))
        collector = self.collect() if self.kills[stage] % 3 == 0 else None  # refused while the stage runs
        self.kills[stage] += program.kill(children=self.kills[stage] % 2 == 1)
        if collector is not None:
            collector.wait_for_end()
        if not (self.run_folder / stage).is_symlink():
            return 1.2 * seconds
        (self.run_folder / stage).unlink()
        self.collect().succeed()
        return 0.7 * seconds

    def kill_gc(self, seconds: float) -> None:
        """Kill a ``gc`` that has one unused result per stage to remove."""
        self.plant_garbage()
        program = self.collect(*(["--checkpoints"] if self.kills["gc"] % 2 else []))
        time.sleep(self.chance.uniform(0, seconds))
        self.kills["gc"] += program.kill()

    def plant_garbage(self) -> None:
        """Add results that no run links to: copies of the run's results under other keys."""
        for stage in STAGES:
            shown = (self.run_folder / stage).resolve()
            shutil.copytree(shown, shown.with_name(f"{self.chance.getrandbits(256):064x}"))


class Program:
    """``cleargs ARGUMENTS...`` in a separate process, which leads its process group."""

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
        """Wait until the program prints ``line`` or ends. Raises TimeoutError after an hour."""
        deadline = time.monotonic() + MAX_SECONDS
        while not self.ended() and line not in self.log.read_text():
            if time.monotonic() > deadline:
                raise TimeoutError(f"{self.arguments} did not print {line!r}")
            time.sleep(0.01)

    def kill(self, *, children: bool = False) -> bool:
        """Send SIGKILL to the program, and to its ``children``. Return False if it had ended before."""
        alive = not self.ended()
        if alive:
            (os.killpg if children else os.kill)(self.pid, SIGKILL)
            self.code = os.waitstatus_to_exitcode(os.waitpid(self.pid, 0)[1])
        output = self.log.read_text()
        if "unexpected" in output or "Traceback" in output:
            raise AssertionError(f"{self.arguments} printed:\n{output}")
        return alive and self.code == -SIGKILL

    def wait_for_end(self) -> None:
        self.wait_for("\0")

    def succeed(self) -> None:
        """Wait for the end of the program. Raises AssertionError if it fails."""
        self.wait_for_end()
        if self.code:
            raise AssertionError(f"{self.arguments} ended with {self.code}:\n{self.log.read_text()}")


def digests(run: Path) -> dict[str, dict[str, str]]:
    """Stage -> file -> digest, from the manifests."""
    manifests = {stage: json.loads((run / stage / "manifest.json").read_bytes()) for stage in STAGES}
    return {
        stage: {name: record["digest"] for name, record in manifest["files"].items()}
        for stage, manifest in manifests.items()
    }


def drill(root: Path, kills: int, seed: int) -> dict[str, int]:
    """Kill and finish each program, compare the results, and return the number of kills per program.

    Raises AssertionError if the results differ, or if a program fails.
    """
    for module in (*HEAVY, *(f"cleargs.stages.{stage}" for stage in STAGES)):
        import_module(module)
    this = Drill(root, random.Random(seed))
    synth = ["synth", str(root / "capture"), "--protocol", "mixed", "--frames", "8", "--size", "96x54"]
    # In a separate process, since this one forks and must have no threads.
    Program(synth, root / "log").succeed()
    this.run(root / "undisturbed", threads=2).succeed()
    expected = digests(root / "undisturbed")
    shares = {name: kills // 6 + (number < kills % 6) for number, name in enumerate(this.kills)}
    for stage in STAGES:
        seconds = json.loads((root / "undisturbed" / stage / "manifest.json").read_bytes())["seconds"]
        while this.kills[stage] < shares[stage]:
            seconds = this.kill_stage(stage, seconds)
        this.run(this.run_folder, "--until", stage).succeed()
        print(f"{stage}: {this.kills[stage]} kills", flush=True)
    assert digests(this.run_folder) == expected, "the results differ from those of the undisturbed run"
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
    assert digests(this.run_folder) == expected, "gc removed a result of the run"
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
