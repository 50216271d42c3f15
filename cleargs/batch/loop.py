"""Run the scenes of a batch one after the other, each in a separate process, and collect the results.

::

    BATCH/scenes/NAME/       run folders, as `cleargs run` makes them
    BATCH/store/             one store for all scenes: equal results are shared
    BATCH/exports/           exported scenes and films, if the sheet requests them
    BATCH/logs/NAME.log      the output of the last attempt
    BATCH/summary.csv        one row per scene
    BATCH/report/index.html  a page with all scenes
"""

from __future__ import annotations

import subprocess
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

from cleargs.batch.sheet import SceneJob, SheetError
from cleargs.batch.summary import HEADER, SUMMARY, Result, State
from cleargs.capture.sources import whole_capture
from cleargs.errors import CleargsError, InputError, listed
from cleargs.files import write_bytes
from cleargs.own_files import refuse_links
from cleargs.pipeline.outputs import Place
from cleargs.pipeline.plan import Planner, StagePlan
from cleargs.pipeline.run_file import RUN_FILE, SCENE, RunSpec
from cleargs.pipeline.runner import check_same_input
from cleargs.pipeline.session import opened_store, resolve_run, usable_cores
from cleargs.pipeline.stages import Stages
from cleargs.pipeline.store import is_store, visible_names
from cleargs.progress import Reporter, SilentReporter
from cleargs.render import TARGETS
from cleargs.report.report_json import linked_manifests
from cleargs.safe_io import read_bytes
from cleargs.subprocesses import module_command
from cleargs.types import Device


@dataclass(frozen=True)
class Batch:
    """The scenes of a sheet, and the options with which they run."""

    dag: Stages
    folder: Path
    """Absolute path of the batch."""
    scenes: Sequence[SceneJob]
    device: Device
    until: str | None = None
    """The last stage to run; None for all."""
    overrides: tuple[str, ...] = ()
    """Settings of all scenes. Those of a scene override them."""
    options: tuple[str, ...] = ()
    """More options for each ``cleargs run``."""

    def run_folder(self, scene: SceneJob) -> Path:
        return self.folder / "scenes" / scene.name

    def log(self, scene: SceneJob) -> Path:
        """Return the file with the output of the last attempt."""
        return self.folder / "logs" / f"{scene.name}.log"

    def arguments(self, scene: SceneJob) -> list[str]:
        """Return the arguments of ``cleargs`` that run ``scene``."""
        settings = [word for text in (*self.overrides, *scene.overrides) for word in ("--set", text)]
        until = ["--until", self.until] if self.until else []
        run, store = str(self.run_folder(scene)), str(self.store)
        return [
            *("run", str(scene.source), "-o", run, "--store", store),
            *("--recipe", scene.recipe, *settings, *until, "--device", self.device, *self.options),
        ]

    def check(self, sheet: Path) -> None:
        """Raise SheetError if a scene cannot run, so that hours of work do not end in a missing file.

        Causes are a missing input, a wrong setting, a missing model, or a run folder of another input. Raises
        InputError if the folder has content and is not a batch, or if the batch would replace its sheet, a
        recipe or a capture, and StoreError if a part of the folder is a link.
        """
        written = [self.folder / name for name in ("summary.csv", "report", "logs", "exports", "store")]
        for place in (sheet, *(Path(text) for job in self.scenes for text in (job.source, job.recipe))):
            for taken in filter(Place(place, hard_links=False).is_inside, written):
                hint = "choose another folder with -o"
                raise InputError(f"the batch would replace {place}: it writes {taken}", hint=hint)
        self._check_folder()
        problems = []
        for scene in self.scenes:
            try:
                run = self._run(scene)
                with opened_store(run.store) as store:
                    check_same_input(run, self.dag, store)
                for stage in self.dag.until(self.until)[1:]:  # not ingest, whose files are the capture
                    self.dag.load(stage).externals(run.config.effective[stage], run.source)
                for ending in set(scene.after.export) - set(TARGETS):
                    from cleargs.splat.formats import format_of  # loads torch

                    format_of(Path(f"{scene.name}.{ending}"))
            except InputError as error:
                problems.append(f"{scene.where}: {error}; {error.hint}")
        if problems:
            raise SheetError(sheet, problems)

    def _check_folder(self) -> None:
        names, summary = visible_names(self.folder), self.folder / SUMMARY
        refuse_links(self.folder / part for part in ("scenes", "store", "exports", "logs", "report", SUMMARY))
        refuse_links(place for scene in self.scenes for place in (self.run_folder(scene), self.log(scene)))
        marks = ("plan.json", f"scenes/*/{RUN_FILE}")  # the Snakefile makes the first, a scene the second
        known = is_store(self.store) or any(any(self.folder.glob(mark)) for mark in marks)
        if summary.is_file():
            known = read_bytes(summary, root=self.folder).startswith(HEADER)
        if names and not known:
            raise InputError(
                f"{self.folder} is not empty and is not a batch; it has {listed(names)}",
                hint=f"choose a new or empty folder, for example -o {self.folder / 'batch'}",
            )
        began = summary.is_file() or (self.folder / "plan.json").is_file()  # it exports after that
        if not began and (exported := visible_names(self.exports)):
            raise InputError(
                f"{self.exports} was not made by a batch; it has {listed(exported)}",
                hint="move it, or choose another folder with -o",
            )

    def plan(self, scene: SceneJob) -> list[StagePlan]:
        """Return the state of each stage. Raises CleargsError if the capture cannot be read."""
        run = self._run(scene)
        with opened_store(run.store) as store:
            return Planner(self.dag, run, store, usable_cores(), SilentReporter()).plan(self.until)

    def stages(self, scene: SceneJob) -> tuple[str, ...]:
        """Return the stages that have work with the settings of ``scene``: a draft makes no repairs."""
        return self._run(scene).stages(self.dag)

    def run(self, scene: SceneJob, reporter: Reporter) -> None:
        """Run ``scene`` and the work after it, each in a separate process. Write their output to `log`."""
        self.log(scene).parent.mkdir(parents=True, exist_ok=True)
        write_bytes(self.log(scene), b"")  # replaces a link, and does not write through it
        if self._call(scene, self.arguments(scene), reporter) == 0:
            for arguments in self.arguments_after(scene):
                self.exports.mkdir(exist_ok=True)
                self._call(scene, arguments, reporter, self.exports)

    def arguments_after(self, scene: SceneJob) -> Iterator[list[str]]:
        """Yield the arguments of ``cleargs`` for the work after ``scene`` that is missing or out of date."""
        run, name, after = self.run_folder(scene), scene.name, scene.after
        made = run / SCENE
        wanted = [
            (f"{name}.{kind}", ["export", str(run), "-o", f"{name}.{kind}", "--force"])
            if kind not in TARGETS
            else (f"{name}-{kind}.{TARGETS[kind].ending}", ["export", str(run), "--for", kind, "--force"])
            for kind in after.export
        ]
        if after.render is not None:
            turn = ["--turntable"] if after.render == "turntable" else []
            wanted.append((f"{name}.mp4", ["render", str(run), "-o", f"{name}.mp4", "--force", *turn]))
        for pattern, arguments in wanted if made.is_file() else ():
            ages = [file.stat().st_mtime for file in self.exports.glob(pattern)]
            if not ages or min(ages) < made.stat().st_mtime:
                yield arguments

    @property
    def store(self) -> Path:
        """Store of all scenes."""
        return self.folder / "store"

    @property
    def exports(self) -> Path:
        """Folder of exported scenes and films."""
        return self.folder / "exports"

    def _call(
        self, scene: SceneJob, arguments: Sequence[str], reporter: Reporter, folder: Path | None = None
    ) -> int:
        """Run ``cleargs`` in ``folder``, and copy its output to the log and to ``reporter``."""
        with (
            self.log(scene).open("a", encoding="utf-8") as file,
            subprocess.Popen(
                [*program(), *arguments],
                cwd=folder,
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
            return child.returncode

    def result(self, scene: SceneJob) -> Result:
        """Return the present state and figures of ``scene``."""
        made = linked_manifests(self.run_folder(scene), self.dag.names)
        return Result.of(scene.name, made, *self._state(scene))

    def _state(self, scene: SceneJob) -> tuple[State, str]:
        try:
            plans = self.plan(scene)
        except CleargsError as error:
            return "failed", str(error)
        unfinished = next((plan for plan in plans if plan.state != "done"), None)
        if unfinished is None and not any(self.arguments_after(scene)):
            last = plans[-1].manifest
            missing = last.inherited if last is not None else ()
            return ("partial", "; ".join(missing)) if missing else ("done", "")
        if unfinished is not None and unfinished.state == "partial":
            return "partial", "; ".join(unfinished.reasons)
        with suppress(OSError):  # no attempt yet
            lines = read_bytes(self.log(scene), root=self.folder).decode("utf-8", "replace").splitlines()
            if errors := [line[7:] for line in lines if line.startswith("error: ")]:
                return "failed", errors[-1]
        return "waiting", ""

    def _run(self, scene: SceneJob) -> RunSpec:
        run = resolve_run(
            self.dag,
            whole_capture(scene.source),
            self.run_folder(scene),
            recipe=scene.recipe,
            overrides=(*self.overrides, *scene.overrides),
            store=self.store,
            device="cpu",
            reporter=SilentReporter(),
        )
        # The device is not checked: a login node may not have it.
        return replace(run, device=self.device)


def program() -> list[str]:
    """Return a command that starts ``cleargs`` even if its script is not next to the interpreter."""
    return module_command("cleargs")
