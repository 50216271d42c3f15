"""The runner: find the results of each stage in the store, or run the stage and publish them."""

from __future__ import annotations

import os
import re
import resource
import sys
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from filecmp import cmp
from pathlib import Path, PurePosixPath
from typing import Any, Literal

from cleargs.digest import file_digest, tree_digest
from cleargs.errors import CleargsError, InputError, StageError, StoreError
from cleargs.files import disk_errors, link_or_copy
from cleargs.manifest import (
    FileRecord,
    Manifest,
    damages,
    has_results,
    hidden_link,
    last_shown,
    plain_json,
    published_files,
    versions,
    write_manifest,
)
from cleargs.own_files import drop_links
from cleargs.pipeline.live import recorded_progress
from cleargs.pipeline.lock import exclusive_lock
from cleargs.pipeline.plan import (
    NO_RESULTS,
    STEADY_S,
    Planner,
    StageKey,
    StagePlan,
    check_address_space,
    check_disk,
    cost_line,
    rerun_lines,
)
from cleargs.pipeline.run_file import LOCK, RUN_FILE, SCENE, RunSpec, known_metadata, write_run_file
from cleargs.pipeline.stage import StageContext, StageResult
from cleargs.pipeline.stages import Stages
from cleargs.pipeline.store import Entry, Spent, Store, copied_key
from cleargs.progress import WarningsOnly
from cleargs.timing import cpu_seconds, recorded

BUSY = 1.5
"""Time by the clock divided by processor time from which other programs are named as the cause."""


@dataclass(frozen=True)
class StageOutcome:
    """Outcome of one stage of a run."""

    stage: str
    how: Literal["found", "made"]
    manifest: Manifest
    folder: Path


class Runner(Planner):
    """Plans the stages of one run, and runs them. `run_until` holds ``store.in_use()`` while it works."""

    def run_until(
        self, until: str | None = None, *, force: Sequence[str] = (), allow_partial: bool = False
    ) -> list[StageOutcome]:
        """Find or make the results of each stage up to ``until``, and link them into the run folder.

        Stages in ``force`` run even if their results are in the store. The run stops after a stage that is
        done only in part, unless ``allow_partial``; the last outcome lists what is missing. Raises InputError
        before the first stage if a model is missing, and CleargsError if a stage fails; those before it stay.
        """
        check_address_space()
        forced = tuple(self.dag.check(name) for name in force)
        plans = self.plan(until, forced)
        for plan in plans:
            if plan.state != "done":
                self.dag.load(plan.stage).preflight(self.run.config.effective[plan.stage])
        check_address_space(plans)
        check_disk(plans, self.store.root)
        if self.run.device == "cpu":
            self.dag.prepare([plan.stage for plan in plans if plan.state != "done"])
        for line in (*rerun_lines(plans), cost_line(plans)):
            if line:
                self.reporter.info(line)
        outcomes: list[StageOutcome] = []
        done: dict[str, Manifest] = {}
        made: dict[str, Manifest] = {}
        lock = exclusive_lock(self.run.folder / LOCK, self.reporter, self.run.folder.name)
        with lock, self.store.in_use():
            check_same_input(self.run, self.dag, self.store)
            self._unlink_outdated()  # before run.toml changes: no results of other settings
            write_run_file(self.run)
            self.store.add_root(self.run.folder)
            for name in (plan.stage for plan in plans):
                outcome = self._find_or_make(name, done, forced=name in forced)
                done[name] = outcome.manifest
                outcomes.append(outcome)
                if outcome.how == "made":
                    self._unlink_outdated()
                    made[name] = outcome.manifest
                    self._revise([plan for plan in plans if plan.stage not in done], done, made)
                if outcome.manifest.status == "partial" and not allow_partial:
                    break
            if os.path.lexists(self.run.folder / SCENE) and not self._is_own_scene():
                self.reporter.warn(f"{self.run.folder / SCENE} was not made by ClearGS, and is not the scene")
        return outcomes

    def _unlink_outdated(self) -> None:
        """Remove the links to results of other settings or inputs."""
        for name in self.outdated():
            self.store.unlink(self.run.folder, name)
        self._link_scene()

    def _link_scene(self) -> None:
        """Let ``RUN/scene.ply`` point to the scene of the last stage that has one; remove it if none has."""
        folder, link = self.run.folder, self.run.folder / SCENE
        done = [name for name in self.dag.names if has_results(folder, name)]
        targets = [Path(name, SCENE) for name in done if (folder / name / SCENE).is_file()]
        with disk_errors(link):
            if link.is_symlink():
                current = link.readlink() in targets[-1:]
            else:
                current = any(_is_same(link, folder / target) for target in targets[-1:])
            if not current and self._is_own_scene():
                link.unlink()
            if targets and not os.path.lexists(link):
                link_or_copy(targets[-1], link)

    def _is_own_scene(self) -> bool:
        """Return True if ``RUN/scene.ply`` is a link of ClearGS, or a copy, on a disk without links."""
        folder, scene = self.run.folder, self.run.folder / SCENE
        if scene.is_symlink():
            return scene.readlink() in [Path(name, SCENE) for name in self.dag.names]
        places = [place for name in self.dag.names for place in (folder / name, hidden_link(folder, name))]
        return any(copied_key(place) and _is_same(scene, place / SCENE) for place in places)

    def _revise(
        self, plans: Sequence[StagePlan], done: Mapping[str, Manifest], made: Mapping[str, Manifest]
    ) -> None:
        """Report the cost of the remaining stages again, from what was read and how long it took.

        The first stage depends more on the capture than on the machine. Its time counts only where other
        programs took the processor.
        """
        last = list(made.values())[-1]
        # Alone, a stage gets at least the time of one core, except while it waits for another process that
        # compiles kernels.
        wall, own = last.seconds, last.cpu_seconds or 0.0
        busy = wall > BUSY * own and wall > STEADY_S
        pace = self.pace_of(made) if busy or len(made) > 1 else 1.0
        costs = [
            replace(plan, estimate=self.estimate(plan.stage, done).at_pace(pace))
            for plan in plans
            if plan.estimate is not None and self._has_work(plan.stage)
        ]
        if line := cost_line(costs):
            note = (
                f"; other programs are busy: {last.stage} got {own:.0f} s of processor time in {wall:.0f} s"
            )
            self.reporter.info(f"new {line}{note if busy else ''}")

    def _find_or_make(self, name: str, done: Mapping[str, Manifest], *, forced: bool) -> StageOutcome:
        """Find or make the results of ``name``, and link them into the run folder."""
        stage_key = self.stage_key(name, done)
        entry = self.store.find(name, stage_key.parts.key)
        manifest = entry.complete if entry is not None and not forced else None
        how: Literal["found", "made"] = "found"
        if manifest is None:
            stage_key = self._rehashed_key(name, done)
            entry = self.store.find(name, stage_key.parts.key)
            reasons = ("forced",) if forced else self.reasons(stage_key, entry)
            with self.store.lock(stage_key.parts.key, self.reporter, name) as locked:
                entry = self.store.find(name, stage_key.parts.key)
                if entry is not None and entry.damage is not None:
                    self.reporter.warn(
                        f"{name}: the stored results are damaged ({entry.damage}); the stage runs again"
                    )
                    entry = None
                manifest = entry.complete if entry is not None and not forced else None
                if manifest is None:  # otherwise another process made it in the meantime
                    because = "" if reasons == (NO_RESULTS,) else f" ({'; '.join(reasons)})"
                    if self._has_work(name):
                        self.reporter.info(f"{name}: started{because}")
                    manifest, how = self._make(stage_key, entry, forced=forced, locked=locked), "made"
        manifest = self._with_inherited(manifest, stage_key.inherited)
        self.store.link(self.run.folder, name, stage_key.parts.key)
        self._link_scene()
        return StageOutcome(name, how, manifest, self.store.folder(name, stage_key.parts.key))

    def _has_work(self, name: str) -> bool:
        """Return False for a stage that only hands on the results of others, as repairs in a draft."""
        return name in self.run.stages(self.dag)

    def _rehashed_key(self, name: str, done: Mapping[str, Manifest]) -> StageKey:
        """Return the key of ``name`` after reading all inputs again: a failing disk changes no time stamp.

        Raises StoreError if an upstream result is damaged.
        """
        for upstream, paths in self.dag.load(name).INPUTS.items():
            manifest = done[upstream]
            folder = self.store.folder(upstream, manifest.key)
            names = [str(PurePosixPath(path, file)) for path in paths for file in manifest.under(path)]
            damaged = next(damages(folder, manifest, names, self.store.memo, rehash=True), None)
            if damaged is not None:
                raise StoreError(
                    f"{upstream}: the stored results are damaged ({damaged})",
                    hint="give the same command again; it replaces them",
                )
        return self.stage_key(name, done, rehash=True)

    def _make(self, stage_key: StageKey, entry: Entry | None, *, forced: bool, locked: bool) -> Manifest:
        """Run the stage and publish its results. The caller holds the lock of the key."""
        name = stage_key.parts.stage
        stage = self.dag.load(name)
        work = self.store.open_work(
            stage_key.parts.key, forced=forced, entry=entry, leftovers=stage.LEFTOVERS, locked=locked
        )
        context = self.context(name, stage_key.inputs, work)
        drop_links(context.cache, in_place=context.cache)
        started, clock, usage = datetime.now(UTC), time.monotonic(), Usage()
        shown = self.reporter if self._has_work(name) else WarningsOnly(self.reporter)
        progress = recorded_progress(shown, self.run.folder, name, work.folder)
        with recorded() as times, progress as reporter:

            def spent() -> Spent:
                compiling = reporter.compile_seconds
                return work.spent.plus(
                    Spent(time.monotonic() - clock - compiling, usage.cpu_seconds, compiling)
                )

            try:
                result = self._run_stage(name, replace(context, reporter=reporter))
            except BaseException:  # also when interrupted: the time counts when the stage resumes
                work.note_spent(spent())
                raise
        took = spent()
        cost = {
            "seconds": round(took.clock, 3),
            "compile_seconds": round(took.compiling, 3),
            "cpu_seconds": round(took.processor, 3),
            "peak_memory_gb": round(usage.peak_memory_gb, 3),
            "timing": tuple(times.rows()),
        }
        now = self.external_digests(name)
        if now != {role: stage_key.origins[role] for role in now}:
            self.store.discard(work.folder)
            raise StageError(
                f"the input changed while {name} was reading it", hint="give the same command again"
            )
        absent = [output for output in stage.OUTPUTS if not (work.out / output).exists()]
        if absent and not result.missing:
            raise StageError(
                f"{name} ended without its outputs {', '.join(absent)}",
                hint=f"this is a bug in the stage; please report it with {self.run.folder / RUN_FILE}",
            )
        from cleargs.parquet import table_meanings  # loads pyarrow

        files = {
            name: FileRecord(size=file.stat().st_size, digest=file_digest(file))
            for name, file in published_files(work.out).items()
        }
        manifest = Manifest(
            stage=name,
            key=stage_key.parts.key,
            status="partial" if result.missing or stage_key.inherited else "complete",
            missing=result.missing,
            inherited=stage_key.inherited,
            parts=stage_key.parts,
            origins=stage_key.origins,
            files=files,
            columns=table_meanings(work.out, files),
            digest=tree_digest({name: record.digest for name, record in files.items()}),
            versions=versions(),
            started=started.isoformat(timespec="seconds"),
            device=self.run.device,
            summary=plain_json(result.summary),
            **cost,
        )
        published = self.store.publish(work, manifest, forced=forced)
        if forced and entry is not None and entry.manifest is not None:
            if entry.manifest.digest == manifest.digest:
                self.reporter.info(f"{name}: the new results have the same digests as before")
            else:
                before, here = (one.versions.get("processor") for one in (entry.manifest, manifest))
                why = f", which were made on {before}, not {here}" if before and before != here else ""
                self.reporter.warn(f"{name}: the new results have other digests than before{why}")
        # An equal result that was already there keeps its manifest; the outcome has the cost of this attempt.
        return published.model_copy(update=cost)

    def _run_stage(self, name: str, context: StageContext[Any]) -> StageResult:
        """Run the stage ``name``. Raises StageError, with one line about the cause, if the GPU fails."""
        try:
            return self.dag.load(name).run(context)
        except Exception as error:
            fault = self.dag.gpu_fault(error) if context.device == "cuda" else None
            if fault is None or isinstance(error, CleargsError):
                raise
            raise StageError(
                f"{name}: the GPU failed ({fault})",
                hint="test the GPU with cleargs doctor --gpu, or run on the CPU with --device cpu",
            ) from error

    def _with_inherited(self, manifest: Manifest, inherited: tuple[str, ...]) -> Manifest:
        """Return ``manifest`` with the present list of outputs that are missing upstream.

        The list may change while the content of the inputs, and so the key, stays the same. The manifest is
        then replaced (atomically), and the outputs stay as they are.
        """
        if manifest.inherited == inherited:
            return manifest
        status: Literal["complete", "partial"] = "partial" if manifest.missing or inherited else "complete"
        changed = manifest.model_copy(update={"inherited": inherited, "status": status})
        write_manifest(self.store.folder(manifest.stage, manifest.key), changed)
        return changed


def _is_same(file: Path, other: Path) -> bool:
    return file.is_file() and other.is_file() and cmp(file, other, shallow=False)


def check_same_input(run: RunSpec, dag: Stages, store: Store) -> None:
    """Raise InputError if ``run.folder`` is a run of another capture than ``run.source``.

    A capture at another path is the same if its content is equal.
    """
    before = known_metadata(run.folder).source
    if before is None or before == run.source:
        return
    first = dag.names[0]
    made = last_shown(run.folder, first)
    if made is not None:
        externals = dag.load(first).externals(run.config.effective[first], run.source)
        now = {role: tree_digest(store.memo.digests_of(place)) for role, place in externals.items()}
        if now == dict(made.parts.externals):
            return
    raise InputError(
        f"{run.folder} is a run of {before}, not of {run.source}",
        hint="choose another folder with -o, or delete this one",
    )


class Usage:
    """Processor time and memory that this process uses from now on.

    On Linux, the kernel's peak of the resident memory is reset. Elsewhere, the peak is that of the whole
    process, and may come from an earlier stage.
    """

    def __init__(self) -> None:
        with suppress(OSError):
            Path("/proc/self/clear_refs").write_text("5")  # resets the peak (man 5 proc)
        self._cpu_seconds, self._peak_of_children = cpu_seconds(), _peak(resource.RUSAGE_CHILDREN)

    @property
    def cpu_seconds(self) -> float:
        """Processor time of all threads and of ended child processes, in seconds."""
        return cpu_seconds() - self._cpu_seconds

    @property
    def peak_memory_gb(self) -> float:
        """Peak of the resident memory, GB (1e9 bytes); that of a child if it is the largest so far."""
        own, children = _peak(resource.RUSAGE_SELF), _peak(resource.RUSAGE_CHILDREN)
        with suppress(OSError):
            if found := re.search(r"VmHWM:\s+(\d+)", Path("/proc/self/status").read_text()):
                own = int(found[1]) * 1024
        return max(own, children if children > self._peak_of_children else 0) / 1e9


def _peak(who: int) -> int:
    """Return the peak in bytes. macOS counts in bytes, Linux in KiB."""
    return resource.getrusage(who).ru_maxrss * (1 if sys.platform == "darwin" else 1024)
