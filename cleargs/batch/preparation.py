"""Before the engine starts: run folders for all scenes, handles that say what the store holds, the plan."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

from cleargs.batch.folder import BatchFolder, Plan
from cleargs.batch.resources import Resources, resources
from cleargs.batch.scenes import Scene
from cleargs.batch.sheet import Problem
from cleargs.children import module_command
from cleargs.digest import DigestMemo
from cleargs.errors import CleargsError, InputError
from cleargs.manifest import Manifest, linked_manifest
from cleargs.pipeline.dag import Dag
from cleargs.pipeline.plan import Planner
from cleargs.pipeline.run_file import Device, Run, write_run_file
from cleargs.pipeline.runner import check_same_input
from cleargs.pipeline.stage import Estimate
from cleargs.pipeline.store import Store
from cleargs.progress import Reporter, SilentReporter

WATCHER = tuple(module_command("cleargs.batch.job"))


@dataclass(frozen=True)
class Preparation:
    """How the scenes of a sheet are made ready."""

    dag: Dag
    folder: BatchFolder
    device: Device
    until: str | None = None
    options: tuple[str, ...] = ()
    """Further options of every ``cleargs stage``."""
    program: tuple[str, ...] = (str(Path(sys.executable).with_name("cleargs")),)
    """How ``cleargs`` is called on the nodes."""
    report: bool = True
    """Whether every scene ends with its report."""

    def conflicts(self, scenes: Sequence[Scene]) -> list[Problem]:
        """Scenes whose run folder was made for another input, or whose settings name a model that is not
        there: hours of jobs are not to end in a missing file."""
        found = []
        with DigestMemo(self.folder.store / "digests.sqlite") as memo:
            store = Store(self.folder.store, memo)
            for scene in scenes:
                try:
                    check_same_input(self._run(scene), self.dag, store)
                    for stage in self.dag.until(self.until)[1:]:  # the first one's files are the capture
                        self.dag.load(stage).externals(scene.config.sections[stage], scene.source)
                except InputError as error:
                    found.append(Problem(scene.line, f"{error}; {error.hint}"))
        return found

    def prepare(self, scenes: Sequence[Scene], reporter: Reporter, *, dry_run: bool = False) -> Plan:
        """Write the run files, refresh the handles, write the plan. A dry run writes only handles and a plan
        of its own, and opens no capture: its jobs ask for the least.
        """
        wanted = self.dag.until(self.until)
        asked: dict[str, dict[str, Resources]] = {}
        with (
            DigestMemo(self.folder.store / "digests.sqlite") as memo,
            reporter.task("scenes made ready", len(scenes)) as task,
            ExitStack() as held,
        ):
            store = Store(self.folder.store, memo)
            if not dry_run:
                held.enter_context(store.in_use())  # what is linked here is not collected meanwhile
            for scene in scenes:
                run = self._run(scene)
                planner = Planner(self.dag, run, store, 1, SilentReporter())
                if not dry_run:
                    write_run_file(run)
                done = self._finished(planner)
                estimates = {} if dry_run else self._estimates(planner, set(wanted) - done.keys())
                for stage in self.dag.names:
                    self.folder.refresh(scene.name, stage, done.get(stage))
                    if stage in done and not dry_run:
                        store.link(run.folder, stage, done[stage].key)
                    elif not dry_run:
                        self.folder.forget_status(scene.name, stage)
                asked[scene.name] = {
                    stage: resources(stage, estimates.get(stage), scene.wanted[stage], self.device)
                    for stage in self.dag.names
                }
                task.advance()
        plan = Plan(
            watcher=WATCHER,
            program=self.program,
            options=self.options,
            stages={stage: tuple(self.dag.load(stage).INPUTS) for stage in self.dag.names},
            until=wanted[-1],
            report=self.report,
            scenes=asked,
        )
        self.folder.write_plan(plan, dry_run=dry_run)
        return plan

    def _run(self, scene: Scene) -> Run:
        folder = self.folder.run(scene.name)
        return Run(folder, scene.source, scene.config, self.folder.store, self.device)

    def _finished(self, planner: Planner) -> Mapping[str, Manifest]:
        """Stages whose results are there. A scene that never ran is not looked at: its capture may be large.

        A capture that cannot be read counts as nothing finished; its job will say why.
        """
        if all(linked_manifest(planner.run.folder, stage) is None for stage in self.dag.names):
            return {}
        try:
            return {plan.stage: plan.manifest for plan in planner.plan() if plan.manifest is not None}
        except CleargsError:
            return {}

    def _estimates(self, planner: Planner, stages: set[str]) -> dict[str, Estimate]:
        """The stages' own estimates; a stage that cannot say (a capture that cannot be read) is left out."""
        found = {}
        for stage in stages:
            try:
                found[stage] = planner.estimate(stage)
            except (CleargsError, OSError):
                continue
        return found
