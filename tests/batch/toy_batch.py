"""A batch of toy scenes with the stages of ``tests/pipeline/toy.py``."""

from __future__ import annotations

import csv
import json
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import toy
from toy import toy_dag

from cleargs.cli.main import invoke
from cleargs.manifest import read_manifest
from cleargs.pipeline.stages import Stages

SCENES = ("attic", "barn", "cellar")


@dataclass(frozen=True)
class ToyBatch:
    """A sheet of captures with six different numbers per scene."""

    root: Path

    @property
    def dag(self) -> Stages:
        return toy_dag(self.root / "journal")

    @property
    def folder(self) -> Path:
        return self.root / "sheet.batch"

    @property
    def hold(self) -> Path:
        """While this file exists, `square` of a held sheet waits after its first number."""
        return self.root / "hold"

    def write_sheet(self, scenes: dict[str, str] | None = None, *, held: bool = False) -> Path:
        """Write a sheet of ``scenes``: name -> lines below its ``[[scene]]``. None means all scenes."""
        lines = ['recipe = "empty.toml"']
        if held:
            self.hold.touch()
            lines.append(f"[set]\nsquare.hold = {json.dumps(str(self.hold))}\nsquare.delay_s = 0.3")
        for name, own in (scenes or dict.fromkeys(SCENES, "")).items():
            lines.append(f'[[scene]]\nname = "{name}"\ninput = "{name}"\n{own}')
        sheet = self.root / "sheet.toml"
        sheet.write_text("\n".join(lines))
        return sheet

    def run(self, *options: str) -> int:
        """Run `cleargs batch` and return its exit code."""
        return invoke(["batch", str(self.root / "sheet.toml"), "--device", "cpu", *options], self.dag)

    def summary(self) -> dict[str, dict[str, str]]:
        """Return scene -> its row of the summary."""
        with (self.folder / "summary.csv").open() as file:
            return {row["scene"]: row for row in csv.DictReader(file)}

    def lines(self) -> list[str]:
        """Return the lines that stages noted so far."""
        journal = self.root / "journal"
        return journal.read_text().splitlines() if journal.exists() else []

    def work_done(self) -> list[str]:
        """Return the lines that stages noted since the last call."""
        lines = self.lines()
        (self.root / "journal").unlink(missing_ok=True)
        return lines

    def wait_until(self, true: Callable[[], Any], what: str, seconds: float = 240.0) -> None:
        """Wait until ``true`` returns a true value."""
        deadline = time.monotonic() + seconds
        while not true():
            assert time.monotonic() < deadline, f"never saw {what}"
            time.sleep(0.05)

    def digests(self, scene: str) -> dict[str, str]:
        """Return stage -> digest of the results that the run folder links to."""
        folder = self.folder / "scenes" / scene
        return {stage: read_manifest(folder / stage).digest for stage in self.dag.names}

    def undisturbed(self, scene: str) -> dict[str, str]:
        """Return stage -> digest of an undisturbed run of the scene, in a separate store."""
        folder = self.root / "undisturbed" / scene
        recipe = str(self.root / "empty.toml")
        dag = toy_dag(self.root / "other")
        invoke(["run", str(self.root / scene), "-o", str(folder), "--workflow", recipe, "-q"], dag)
        return {stage: read_manifest(folder / stage).digest for stage in dag.names}

    @property
    def program(self) -> list[str]:
        """Command that runs ``cleargs`` with the toy stages."""
        return [sys.executable, str(Path(toy.__file__)), str(self.root / "journal")]
