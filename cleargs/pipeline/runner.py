"""The runner: brings each stage of a run from its recipe to a finished folder in the store."""

from __future__ import annotations

import re
import resource
import sys
import time
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager, suppress
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path, PurePosixPath
from typing import Literal

from cleargs.digest import file_digest, tree_digest
from cleargs.errors import InputError, StageError, StoreError
from cleargs.manifest import (
    FileRecord,
    Manifest,
    damages,
    last_shown,
    plain_json,
    published_files,
    versions,
    write_manifest,
)
from cleargs.pipeline.dag import Dag
from cleargs.pipeline.live import recorded_progress
from cleargs.pipeline.lock import only_one
from cleargs.pipeline.plan import (
    Planner,
    StageKey,
    StagePlan,
    check_address_space,
    check_disk,
    cost_line,
    redo_lines,
)
from cleargs.pipeline.run_file import LOCK, RUN_FILE, RunSpec, read_source, write_run_file
from cleargs.pipeline.store import Entry, Store
from cleargs.progress import Reporter


@dataclass(frozen=True)
class StageOutcome:
    """What became of one stage."""

    stage: str
    how: Literal["found", "made"]
    manifest: Manifest
    folder: Path


class Runner:
    """Runs stages of one run folder. ``store.in_use()`` is held by each public method while it works."""

    def __init__(self, dag: Dag, run: RunSpec, store: Store, threads: int, reporter: Reporter) -> None:
        self.dag = dag
        self.run = run
        self.store = store
        self.reporter = reporter
        self.planner = Planner(dag, run, store, threads, reporter)

    def run_until(
        self, until: str | None = None, *, force: Sequence[str] = (), allow_partial: bool = False
    ) -> list[StageOutcome]:
        """Bring every stage up to ``until`` to a finished folder; link each into the run.

        Stops after a stage that is done only in part unless ``allow_partial``: the last outcome then says
        what is missing. Raises InputError before any work where a model that one of them needs is not
        there, CleargsError where a stage fails; what was finished before it stays.
        """
        check_address_space()
        forced = tuple(self.dag.check(name) for name in force)
        plans = self.planner.plan(until, forced)
        for plan in plans:
            if plan.state != "done":
                self.dag.load(plan.stage).preflight(self.run.config.sections[plan.stage])
        check_disk(plans, self.store.root)
        plans = self.planner.at_measured_pace(plans)
        for line in (*redo_lines(plans), cost_line(plans)):
            if line:
                self.reporter.info(line)
        outcomes: list[StageOutcome] = []
        done: dict[str, Manifest] = {}
        with self._lock_run(), self.store.in_use():
            check_same_input(self.run, self.dag, self.store)
            self._unlink_outdated()  # first: a kill in between leaves nothing of other settings in sight
            write_run_file(self.run)
            self.store.add_root(self.run.folder)
            for name in (plan.stage for plan in plans):
                outcome = self._find_or_make(name, done, forced=name in forced)
                done[name] = outcome.manifest
                outcomes.append(outcome)
                if outcome.how == "made":
                    self._unlink_outdated()
                if name == self.dag.names[0] and outcome.how == "made":
                    self._revise(plans[1:], done)
                if outcome.manifest.status == "partial" and not allow_partial:
                    break
        return outcomes

    def _lock_run(self) -> AbstractContextManager[bool]:
        """Keep the run folder for this process; wait while another one works there."""
        return only_one(self.run.folder / LOCK, self.reporter, self.run.folder.name)

    def _unlink_outdated(self) -> None:
        """Let the run folder show no results of other settings or inputs."""
        for name in self.planner.outdated():
            self.store.unlink(self.run.folder, name)

    def _revise(self, plans: Sequence[StagePlan], done: Mapping[str, Manifest]) -> None:
        """Say what the stages to come cost, now that the capture is known."""
        costs = [
            replace(plan, estimate=self.planner.estimate(plan.stage, done))
            for plan in plans
            if plan.estimate is not None
        ]
        if line := cost_line(costs):
            self.reporter.info(f"now {line}")

    def run_stage(self, name: str, *, force: bool = False, allow_partial: bool = False) -> StageOutcome:
        """Bring one stage to a finished folder, from finished stages before it.

        Raises StageError when a stage before it is not done (or only in part, without ``allow_partial``).
        """
        check_address_space()
        done: dict[str, Manifest] = {}
        with self._lock_run(), self.store.in_use():
            self.store.add_root(self.run.folder)
            self._unlink_outdated()
            for upstream in self.dag.until(name)[:-1]:
                done[upstream] = self._finished(upstream, done, name, allow_partial=allow_partial)
            outcome = self._find_or_make(name, done, forced=force)
            self._unlink_outdated()
        return outcome

    def _finished(
        self, upstream: str, done: Mapping[str, Manifest], name: str, *, allow_partial: bool
    ) -> Manifest:
        entry = self._find(upstream, self.planner.stage_key(upstream, done))
        if entry is None or entry.manifest is None:
            raise StageError(
                f"{name} needs {upstream}, which is not done",
                hint=f"first: cleargs stage {upstream} {self.run.folder}",
            )
        if entry.manifest.status == "partial" and not allow_partial:
            raise StageError(
                f"{name} needs {upstream}, which is done only in part",
                hint=f"run it again: cleargs stage {upstream} {self.run.folder}; or give --allow-partial",
            )
        return entry.manifest

    def _find(self, name: str, stage_key: StageKey) -> Entry | None:
        """What the store holds for ``stage_key``; something damaged counts as nothing, with a warning."""
        entry = self.store.find(name, stage_key.key)
        if entry is not None and entry.damage is not None:
            self.reporter.warn(
                f"{name}: the stored results are damaged ({entry.damage}); they are made again"
            )
            return None
        return entry

    def _find_or_make(self, name: str, done: Mapping[str, Manifest], *, forced: bool) -> StageOutcome:
        """Find or make the results of ``name``, and let the run folder show them."""
        stage_key = self.planner.stage_key(name, done)
        entry = self.store.find(name, stage_key.key)
        manifest = entry.whole if entry is not None and not forced else None
        how: Literal["found", "made"] = "found"
        if manifest is None:
            stage_key = self._rehashed_key(name, done)
            entry = self.store.find(name, stage_key.key)
            reasons = ("forced",) if forced else self.planner.reasons(stage_key, entry)
            with self.store.lock(stage_key.key, self.reporter, name) as alone:
                entry = self._find(name, stage_key)
                manifest = entry.whole if entry is not None and not forced else None
                if manifest is None:  # else another process made it while we waited
                    self.reporter.info(f"{name}: starts ({'; '.join(reasons)})")
                    manifest, how = self._make(stage_key, entry, forced=forced, alone=alone), "made"
        manifest = self._with_inherited(manifest, stage_key.inherited)
        self.store.link(self.run.folder, name, stage_key.key)
        return StageOutcome(name, how, manifest, self.store.folder(name, stage_key.key))

    def _rehashed_key(self, name: str, done: Mapping[str, Manifest]) -> StageKey:
        """What ``name`` is made from, every byte of it read: a disk that rots tells no time stamp.

        Raises StoreError when an upstream result is damaged.
        """
        for upstream, paths in self.dag.load(name).INPUTS.items():
            manifest = done[upstream]
            folder = self.store.folder(upstream, manifest.key)
            names = [str(PurePosixPath(path, file)) for path in paths for file in manifest.under(path)]
            damaged = next(damages(folder, manifest, names, self.store.memo, rehash=True), None)
            if damaged is not None:
                raise StoreError(
                    f"{upstream}: the stored results are damaged ({damaged})",
                    hint="the same command makes them again",
                )
        return self.planner.stage_key(name, done, rehash=True)

    def _make(self, stage_key: StageKey, entry: Entry | None, *, forced: bool, alone: bool) -> Manifest:
        """Let the stage do its work and publish it. The key's lock is held."""
        name = stage_key.parts.stage
        stage = self.dag.load(name)
        work = self.store.open_work(
            stage_key.key, fresh=forced, entry=entry, leftovers=stage.LEFTOVERS, alone=alone
        )
        context = self.planner.context(name, stage_key.inputs, work)
        started, clock, usage = datetime.now(UTC), time.monotonic(), Usage()
        earlier = work.seconds
        try:
            with recorded_progress(self.reporter, self.run.folder, name, work.folder) as reporter:
                result = stage.run(replace(context, reporter=reporter))
        except BaseException:  # an interruption too: what it had done counts when it resumes
            work.note_seconds(earlier + time.monotonic() - clock)
            raise
        seconds = earlier + time.monotonic() - clock
        cost = {
            "seconds": round(seconds, 3),
            "cpu_seconds": round(usage.cpu_seconds, 3),
            "peak_memory_gb": round(usage.peak_memory_gb, 3),
        }
        now = self.planner.external_digests(name)
        if now != {role: stage_key.origins[role] for role in now}:
            self.store.discard(work.folder)
            raise StageError(
                f"the input changed while {name} was reading it", hint="the same command starts it again"
            )
        if not result.missing:
            absent = [output for output in stage.OUTPUTS if not (work.out / output).exists()]
            if absent:
                raise StageError(
                    f"{name} ended without its outputs {', '.join(absent)}",
                    hint=f"this is a fault of the stage; please report it with {self.run.folder / RUN_FILE}",
                )
        files = {
            name: FileRecord(size=file.stat().st_size, digest=file_digest(file))
            for name, file in published_files(work.out).items()
        }
        manifest = Manifest(
            stage=name,
            key=stage_key.key,
            status="partial" if result.missing or stage_key.inherited else "complete",
            missing=result.missing,
            inherited=stage_key.inherited,
            parts=stage_key.parts,
            origins=stage_key.origins,
            files=files,
            digest=tree_digest({name: record.digest for name, record in files.items()}),
            versions=versions(),
            started=started.isoformat(timespec="seconds"),
            device=self.run.device,
            summary=plain_json(result.summary),
            **cost,
        )
        published = self.store.publish(work, manifest)
        if forced and entry is not None and entry.manifest is not None:
            if entry.manifest.digest == manifest.digest:
                self.reporter.info(f"{name}: made again, with the same digests")
            else:
                self.reporter.warn(f"{name}: made again, with other digests than before")
        # An equal result that was there already keeps its own times; this outcome tells those of today.
        return published.model_copy(update=cost)

    def _with_inherited(self, manifest: Manifest, inherited: tuple[str, ...]) -> Manifest:
        """``manifest`` saying what is missing upstream *now*.

        Equal content may come from a whole upstream later. Only the manifest is written anew (atomically);
        the outputs stay as they are.
        """
        if manifest.inherited == inherited:
            return manifest
        status: Literal["complete", "partial"] = "partial" if manifest.missing or inherited else "complete"
        changed = manifest.model_copy(update={"inherited": inherited, "status": status})
        write_manifest(self.store.folder(manifest.stage, manifest.key), changed)
        return changed


def check_same_input(run: RunSpec, dag: Dag, store: Store) -> None:
    """Raise InputError when ``run.folder`` was made for another capture than ``run.source``.

    A capture that moved is the same when its content is.
    """
    before = read_source(run.folder)
    if before is None or before == run.source:
        return
    first = dag.names[0]
    made = last_shown(run.folder, first)
    if made is not None:
        externals = dag.load(first).externals(run.config.sections[first], run.source)
        now = {role: tree_digest(store.memo.digests_of(place)) for role, place in externals.items()}
        if now == dict(made.parts.externals):
            return
    raise InputError(
        f"{run.folder} is a run of {before}, not of {run.source}",
        hint="choose another folder with -o, or delete this one",
    )


class Usage:
    """What a stage used of the machine, counted from where this is made.

    The kernel's mark of the peak is set back where it can be (Linux). Elsewhere the peak is that of the
    process so far, which may be an earlier stage's.
    """

    def __init__(self) -> None:
        with suppress(OSError):
            Path("/proc/self/clear_refs").write_text("5")  # sets the mark back
        self._cpu_seconds, self._peak_of_children = _cpu_seconds(), _peak(resource.RUSAGE_CHILDREN)

    @property
    def cpu_seconds(self) -> float:
        """Processor time of all threads, and of children that have ended, seconds."""
        return _cpu_seconds() - self._cpu_seconds

    @property
    def peak_memory_gb(self) -> float:
        """Largest resident memory, GB (1e9 bytes); a child counts where it was larger than any before."""
        own, children = _peak(resource.RUSAGE_SELF), _peak(resource.RUSAGE_CHILDREN)
        with suppress(OSError):
            if found := re.search(r"VmHWM:\s+(\d+)", Path("/proc/self/status").read_text()):
                own = int(found[1]) * 1024
        return max(own, children if children > self._peak_of_children else 0) / 1e9


def _cpu_seconds() -> float:
    both = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(used.ru_utime + used.ru_stime for used in both)


def _peak(who: int) -> int:
    """Bytes; macOS counts in bytes, Linux in units of 1024."""
    return resource.getrusage(who).ru_maxrss * (1 if sys.platform == "darwin" else 1024)
