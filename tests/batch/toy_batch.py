"""Three toy captures and a sheet of them. Also a program: ``python toy_batch.py ROOT PROFILE OPTIONS...``
is ``cleargs batch ROOT/sheet.toml --profile PROFILE --json OPTIONS...`` with the toy stages."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1] / "pipeline"))

import toy
from toy import toy_dag

from cleargs.batch.folder import BatchFolder
from cleargs.batch.preparation import Preparation
from cleargs.batch.status import SceneState, scene_states
from cleargs.digest import DigestMemo
from cleargs.manifest import read_manifest
from cleargs.pipeline.dag import Dag
from cleargs.pipeline.lock import file_lock
from cleargs.pipeline.run_file import read_run_file
from cleargs.pipeline.runner import Runner
from cleargs.pipeline.store import Store
from cleargs.progress import SilentReporter

SCENES = ("attic", "barn", "cellar")


@dataclass(frozen=True)
class ToyBatch:
    """A sheet, its captures, its batch folder."""

    root: Path

    @property
    def sheet(self) -> Path:
        return self.root / "sheet.toml"

    @property
    def journal(self) -> Path:
        return self.root / "journal"

    @property
    def folder(self) -> BatchFolder:
        return BatchFolder(self.root / "sheet.batch")

    @property
    def dag(self) -> Dag:
        return toy_dag(self.journal)

    def capture(self, scene: str) -> Path:
        return self.root / scene

    def write_sheet(self, head: str = "", scenes: Mapping[str, str] | None = None) -> None:
        """All scenes, or ``scenes``: name -> lines below its ``[[scene]]``."""
        blocks = [
            f'[[scene]]\nname = "{name}"\ninput = "{name}"\n{lines}\n'
            for name, lines in (scenes or dict.fromkeys(SCENES, "")).items()
        ]
        self.sheet.write_text("\n".join([f'recipe = "empty.toml"\n{head}\n', *blocks]))

    @property
    def hold(self) -> Path:
        """While it exists, a `square` of a sheet with ``held()`` waits behind its first number."""
        return self.root / "hold"

    def held(self) -> str:
        """Lines of a sheet that hold every scene amid `square`, until ``hold`` is unlinked."""
        self.hold.touch()
        return f"[set]\nsquare.hold = {json.dumps(str(self.hold))}\n"

    def start(self, profile: str = "local", *options: str, **process: Any) -> subprocess.Popen[str]:
        """A batch as a process of its own; ``process`` goes to Popen."""
        command = [sys.executable, __file__, str(self.root), profile, *options]
        return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, **process)

    def run(self, profile: str = "local", *options: str) -> tuple[int, dict[str, dict[str, Any]]]:
        """A batch to its end: exit code, and scene -> what became of it."""
        return finish(self.start(profile, *options))

    def states(self) -> dict[str, SceneState]:
        """What `cleargs batch-status` would show."""
        plan = self.folder.read_plan()
        return {} if plan is None else {state.scene: state for state in scene_states(self.folder, plan)}

    def lines(self) -> list[str]:
        """What stages noted so far."""
        return self.journal.read_text().splitlines() if self.journal.exists() else []

    def work_done(self) -> list[str]:
        """What stages noted since the last call."""
        lines = self.lines()
        self.journal.unlink(missing_ok=True)
        return lines

    def squares(self) -> list[str]:
        """The numbers that were squared so far."""
        return [line for line in self.lines() if line.startswith("square ")]

    def wait_for(self, line: str) -> None:
        """Until a stage has noted ``line``."""
        self.wait_until(lambda: line in self.lines(), line)

    def wait_until(self, true: Callable[[], bool], what: str = "", seconds: float = 240.0) -> None:
        """Until ``true`` says so."""
        deadline = time.monotonic() + seconds
        while not true():
            assert time.monotonic() < deadline, f"never saw {what!r}: {self.engine_said()}"
            time.sleep(0.05)

    def finished(self, scene: str, stage: str) -> bool:
        """Whether Snakemake would take a stage for done."""
        return self.folder.read_handle(scene, stage) is not None

    def digests(self, scene: str) -> dict[str, str]:
        """Stage -> digest of what the run folder shows."""
        folder = self.folder.run(scene)
        return {stage: read_manifest(folder / stage).digest for stage in self.dag.names}

    def undisturbed(self, scene: str) -> dict[str, str]:
        """Stage -> digest of a run by itself, in a store of its own."""
        run = read_run_file(self.folder.run(scene), self.dag, store=self.root / "undisturbed")
        with DigestMemo(run.store / "digests.sqlite") as memo:
            runner = Runner(toy_dag(self.root / "other"), run, Store(run.store, memo), 1, SilentReporter())
            return {outcome.stage: outcome.manifest.digest for outcome in runner.run_until()}

    @property
    def engine(self) -> int:
        """Number of the engine's process, the last one's where none is at work."""
        return int((self.folder.root / "batch.lock").read_text().split()[1])

    def engine_lives(self) -> bool:
        """Whether the engine's process is there and is no zombie."""
        state = Path(f"/proc/{self.engine}/stat")
        return state.exists() and state.read_text().rpartition(")")[2].split()[0] != "Z"

    def end_engine(self) -> None:
        """Kill the engine, and all that it started on this machine, where a test left it at work."""
        with suppress(FileNotFoundError), file_lock(self.folder.root / "batch.lock", wait=False) as gone:
            if not gone:
                os.killpg(self.engine, signal.SIGKILL)

    def engine_said(self) -> str:
        """The end of the engine's log."""
        log = self.folder.engine_log
        return log.read_text()[-3000:] if log.exists() else "(nothing)"


def finish(batch: subprocess.Popen[str]) -> tuple[int, dict[str, dict[str, Any]]]:
    """Wait for the end of a batch: exit code, and scene -> what became of it."""
    output, errors = batch.communicate(timeout=900)
    assert output, errors
    return batch.returncode, {state["scene"]: state for state in json.loads(output)}


def make_toy_batch(root: Path) -> ToyBatch:
    """Captures of six numbers, each scene with its own, and a sheet that lists them."""
    for tens, scene in enumerate(SCENES):
        (root / scene).mkdir()
        for number in range(10 * tens, 10 * tens + 6):
            (root / scene / f"{number}.txt").write_text(str(number))
    (root / "empty.toml").touch()
    toy = ToyBatch(root)
    toy.write_sheet()
    return toy


def main(root: Path, profile: str, *options: str) -> None:
    """The program: that of the users, but for the stages."""
    from cleargs.cli import batch
    from cleargs.cli.main import main as cleargs

    toys = ToyBatch(root)
    program = (sys.executable, str(Path(toy.__file__)), str(toys.journal))
    batch.Preparation = partial(Preparation, program=program)
    cleargs(["batch", str(toys.sheet), "--profile", profile, "--device", "cpu", "--json", *options], toys.dag)


if __name__ == "__main__":
    main(Path(sys.argv[1]), *sys.argv[2:])
