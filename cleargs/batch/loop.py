"""The scenes of a batch one after the other, each in a process of its own; what became of each.

::

    BATCH/scenes/NAME/       run folders, as `cleargs run` makes them
    BATCH/store/             one store for all scenes: captures with several settings share what they can
    BATCH/logs/NAME.log      the output of the last try
    BATCH/summary.csv        one row per scene
    BATCH/report/index.html  all scenes as a page
"""

from __future__ import annotations

import csv
import io
import subprocess
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Literal

from rich.filesize import decimal

from cleargs.batch.sheet import SceneJob, SheetError
from cleargs.errors import CleargsError, InputError
from cleargs.files import write_bytes
from cleargs.pipeline.dag import Dag
from cleargs.pipeline.plan import Planner, StagePlan
from cleargs.pipeline.run_file import Device, RunSpec
from cleargs.pipeline.runner import check_same_input
from cleargs.pipeline.session import opened_store, resolve_run, usable_cores
from cleargs.progress import Reporter, SilentReporter
from cleargs.report.formatting import duration
from cleargs.report.report_json import linked_manifests
from cleargs.subprocesses import module_command

State = Literal["failed", "waiting", "partial", "done"]
"""`waiting`: there are stages to make, and no try has failed."""


@dataclass(frozen=True)
class Result:
    """State and figures of one scene: a row of ``summary.csv``."""

    scene: str
    state: State
    frames: int | None
    frames_placed: int | None
    psnr_unseen: float | None
    """Of the last scene, on pixels that no training saw, dB."""
    minutes: float
    """Of work, all stages."""
    memory_gb: float
    """The most that a stage took."""
    disk_gb: float
    cause: str
    """Why it failed, or what is missing."""

    def figures(self) -> list[tuple[str, str]]:
        """Return values and their meanings, as far as they are known."""
        found = []
        if self.frames is not None:
            found.append((f"{self.frames_placed} of {self.frames}", "frames placed"))
        if self.psnr_unseen is not None:
            found.append((f"{self.psnr_unseen:.1f} dB", "PSNR on pixels that no training saw"))
        if self.minutes:
            found.append((duration(60 * self.minutes), "of work"))
            found.append((f"{self.memory_gb:.1f} GB", "of memory"))
            found.append((decimal(round(1e9 * self.disk_gb)), "on disk"))
        return found


@dataclass(frozen=True)
class Batch:
    """The scenes of a sheet and how they are run."""

    dag: Dag
    folder: Path
    """Absolute."""
    scenes: Sequence[SceneJob]
    device: Device
    until: str | None = None
    overrides: tuple[str, ...] = ()
    """Settings of all scenes; those of a scene go over them."""
    options: tuple[str, ...] = ()
    """Further options of each ``cleargs run``."""

    def run_folder(self, scene: SceneJob) -> Path:
        """Return the run folder of ``scene``."""
        return self.folder / "scenes" / scene.name

    def log(self, scene: SceneJob) -> Path:
        """Return the file that holds the output of the last try."""
        return self.folder / "logs" / f"{scene.name}.log"

    def arguments(self, scene: SceneJob) -> list[str]:
        """Return the arguments of ``cleargs`` that bring ``scene`` through the stages."""
        settings = [word for text in (*self.overrides, *scene.overrides) for word in ("--set", text)]
        until = ["--until", self.until] if self.until else []
        return [
            *("run", str(scene.source), "-o", str(self.run_folder(scene)), "--store", str(self._store)),
            *("--workflow", scene.recipe, *settings, *until, "--device", self.device, *self.options),
        ]

    def check(self, sheet: Path) -> None:
        """Raise SheetError where a scene has no input, a setting is wrong, a model is missing, or the run
        folder belongs to another input: hours of work are not to end in a missing file.
        """
        problems = []
        for scene in self.scenes:
            try:
                run = self._run(scene)
                with opened_store(run.store) as store:
                    check_same_input(run, self.dag, store)
                for stage in self.dag.until(self.until)[1:]:  # the first one's files are the capture
                    self.dag.load(stage).externals(run.config.sections[stage], run.source)
            except InputError as error:
                problems.append(f"{scene.where}: {error}; {error.hint}")
        if problems:
            raise SheetError(sheet, problems)

    def plan(self, scene: SceneJob) -> list[StagePlan]:
        """Return the state of each stage. Raises CleargsError where the capture cannot be read."""
        run = self._run(scene)
        with opened_store(run.store) as store:
            return Planner(self.dag, run, store, usable_cores(), SilentReporter()).plan(self.until)

    def run(self, scene: SceneJob, reporter: Reporter) -> None:
        """Run ``scene`` in a process of its own; its words go to its log and to ``reporter``."""
        log = self.log(scene)
        log.parent.mkdir(parents=True, exist_ok=True)
        command = [*program(), *self.arguments(scene)]
        with (
            log.open("w", encoding="utf-8") as file,
            subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                encoding="utf-8",
                errors="replace",
            ) as child,
        ):
            try:
                assert child.stdout is not None
                for line in child.stdout:
                    file.write(line)
                    file.flush()
                    reporter.info(f"{scene.name}: {line.rstrip()}")
            except BaseException:
                child.terminate()
                raise
            if child.wait() < 0:
                file.write(f"error: ended by signal {-child.returncode}\n")

    def result(self, scene: SceneJob) -> Result:
        """Return what is there of ``scene``."""
        made = linked_manifests(self.run_folder(scene), self.dag.names)
        ingest = made["ingest"].summary if "ingest" in made else {}
        psnr = [manifest.summary.get("psnr_unseen") for manifest in made.values()]
        state, cause = self._state(scene)
        return Result(
            scene=scene.name,
            state=state,
            frames=ingest.get("frames"),
            frames_placed=ingest.get("registered"),
            psnr_unseen=next((value for value in reversed(psnr) if value is not None), None),
            minutes=round(sum(manifest.seconds for manifest in made.values()) / 60, 2),
            memory_gb=max((manifest.peak_memory_gb or 0.0 for manifest in made.values()), default=0.0),
            disk_gb=round(sum(manifest.bytes for manifest in made.values()) / 1e9, 3),
            cause=cause,
        )

    def _state(self, scene: SceneJob) -> tuple[State, str]:
        try:
            plans = self.plan(scene)
        except CleargsError as error:
            return "failed", str(error)
        unfinished = next((plan for plan in plans if plan.state != "done"), None)
        if unfinished is None:
            last = plans[-1].manifest
            missing = last.inherited if last is not None else ()
            return ("partial", "; ".join(missing)) if missing else ("done", "")
        if unfinished.state == "partial":
            return "partial", "; ".join(unfinished.reasons)
        with suppress(OSError):  # no try yet
            lines = self.log(scene).read_text("utf-8", "replace").splitlines()
            if errors := [line[7:] for line in lines if line.startswith("error: ")]:
                return "failed", errors[-1]
        return "waiting", ""

    def _run(self, scene: SceneJob) -> RunSpec:
        run = resolve_run(
            self.dag,
            scene.source,
            self.run_folder(scene),
            workflow=scene.recipe,
            overrides=(*self.overrides, *scene.overrides),
            store=self._store,
            device="cpu",
            say=lambda line: None,
        )
        return replace(run, device=self.device)  # which a login node need not have

    @property
    def _store(self) -> Path:
        return self.folder / "store"


def program() -> list[str]:
    """Return how ``cleargs`` is started as a child: its script need not be next to the interpreter."""
    return module_command("cleargs.cli.entry")


def write_summary(path: Path, results: Sequence[Result]) -> None:
    """Write one row per scene. Raises StoreError."""
    text = io.StringIO()
    writer = csv.DictWriter(text, [field.name for field in fields(Result)], lineterminator="\n")
    writer.writeheader()
    writer.writerows(asdict(result) for result in results)
    write_bytes(path, text.getvalue().encode())
