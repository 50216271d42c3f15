"""What a run would do: for each stage whether its results are there, and if not, what changed."""

from __future__ import annotations

import resource
import shutil
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

from cleargs.digest import tree_digest
from cleargs.errors import InputError, StoreError
from cleargs.files import External
from cleargs.manifest import KeyParts, Manifest, last_shown, linked_manifest
from cleargs.pipeline.dag import Dag
from cleargs.pipeline.keys import differences, library_versions, plugin_versions, stage_key_config
from cleargs.pipeline.run_file import RunSpec
from cleargs.pipeline.stage import Estimate, StageContext
from cleargs.pipeline.store import Entry, Store, WorkFolder
from cleargs.progress import Reporter
from cleargs.safe_io import require_utf8

MIN_ADDRESS_SPACE_GB = 2.0
"""What the libraries reserve before any work is done."""

WORTH_MEASURING_MIN = 2.0
"""Minutes of expected work from which it is worth seconds to measure how fast this machine is."""

NOT_MADE = "not made yet"
"""Why the results of a stage are not there that the run never had."""

Origins = dict[str, dict[str, str]]

State = Literal["done", "partial", "missing"]
"""`partial`: there, but its own work is not whole."""


@dataclass(frozen=True)
class StageKey:
    """What one stage would be made from, all of it known."""

    parts: KeyParts
    origins: Origins
    inputs: Mapping[str, Path]
    """Upstream stage -> its finished folder."""
    inherited: tuple[str, ...]
    """What the stages before could not make."""

    @property
    def key(self) -> str:
        """The key of the stage's results."""
        return self.parts.key


@dataclass(frozen=True)
class StagePlan:
    """The state of one stage of a run."""

    stage: str
    state: State
    reasons: tuple[str, ...]
    """Why it is no hit, or what a partial one lacks."""
    estimate: Estimate | None = None
    """Cost of the work to do; None where there is none."""
    stage_key: StageKey | None = None
    """None while a stage before it must run first. As keys are made of content, it may be done after all."""
    manifest: Manifest | None = None
    """That of a stage that is done."""

    @property
    def key(self) -> str | None:
        """The key of the stage's results; None while a stage before it must run first."""
        return self.stage_key.key if self.stage_key is not None else None


@dataclass
class Planner:
    """Makes recipes and compares them with what the store and the run folder hold. Writes nothing."""

    dag: Dag
    run: RunSpec
    store: Store
    threads: int
    reporter: Reporter
    _estimates: dict[tuple[str, ...], Estimate] = field(default_factory=dict, repr=False)

    def stage_key(self, name: str, done: Mapping[str, Manifest], *, rehash: bool = False) -> StageKey:
        """What ``name`` is made from, given the manifests of the stages before it.

        With ``rehash`` every external is read, whatever the memo says of it. Raises InputError when one (the
        capture, a model) cannot be read.
        """
        stage, config = self.dag.load(name), self.run.config.sections[name]
        inputs, origins = self.inputs(name, done)
        digests = self.external_digests(name, rehash=rehash)
        origins.update(digests)
        parts = KeyParts(
            stage=name,
            version=stage.VERSION,
            config=stage_key_config(stage, name, self.run.config.sections),
            inputs=inputs,
            externals={role: tree_digest(files) for role, files in digests.items()},
            seed=self.run.config.seed,
            device=self.run.device,
            libraries=library_versions(stage, self.run.device) | plugin_versions(config),
        )
        folders = {upstream: self.store.folder(upstream, done[upstream].key) for upstream in stage.INPUTS}
        inherited: dict[str, None] = {}  # in order, each once
        for upstream in stage.INPUTS:
            inherited |= dict.fromkeys(done[upstream].inherited)
            inherited |= dict.fromkeys(f"{upstream}: {missing}" for missing in done[upstream].missing)
        return StageKey(parts, origins, folders, tuple(inherited))

    def inputs(
        self, name: str, done: Mapping[str, Manifest]
    ) -> tuple[dict[str, dict[str, str | None]], Origins]:
        """Digests of what ``name`` reads of the stages before it, and those of the single files."""
        origins: Origins = {}
        inputs: dict[str, dict[str, str | None]] = {}
        for upstream, paths in self.dag.load(name).INPUTS.items():
            inputs[upstream] = {}
            for path in paths:
                files = done[upstream].under(path)
                origins[f"{upstream}/{path}"] = files
                inputs[upstream][path] = tree_digest(files) if files else None
        return inputs, origins

    def _externals(self, name: str) -> Mapping[str, External]:
        return self.dag.load(name).externals(self.run.config.sections[name], self.run.source)

    def external_digests(self, name: str, *, rehash: bool = False) -> dict[str, dict[str, str]]:
        """Role -> relative path -> digest of what ``name`` reads outside the store.

        With ``rehash`` every file is read. Raises InputError when one cannot be read or holds the run.
        """
        places = self._externals(name)
        hint = "choose a folder beside the input with -o"
        for folder in (self.run.folder, self.run.source, self.store.root):
            require_utf8(folder)
        if self.run.folder == self.run.source:
            raise InputError(f"the run folder {self.run.folder} is the input itself", hint=hint)
        for place in places.values():
            if isinstance(place, Path) and self.run.folder.is_relative_to(place):
                raise InputError(f"the run folder {self.run.folder} lies inside the input {place}", hint=hint)
        return {role: self.store.memo.digests_of(place, rehash=rehash) for role, place in places.items()}

    def reasons(self, stage_key: StageKey, entry: Entry | None) -> tuple[str, ...]:
        """Why the results of ``stage_key`` are not there, in lines for a reader."""
        if entry is not None and entry.damage is not None:
            return (f"damaged: {entry.damage}",)
        if entry is not None and entry.usable is not None:
            return tuple(f"retried, was missing: {missing}" for missing in entry.usable.missing)
        before = last_shown(self.run.folder, stage_key.parts.stage)
        if before is None:
            return (NOT_MADE,)
        changes = differences(before.parts, stage_key.parts, before.origins, stage_key.origins)
        return tuple(changes) or ("its results were removed from the store",)

    @cached_property
    def pace(self) -> float:
        """By which estimates are multiplied: this machine's time over that of the one they were made on."""
        return self.dag.pace(None)

    def at_measured_pace(self, plans: list[StagePlan]) -> list[StagePlan]:
        """``plans`` with the costs on this machine, whose pace is measured now unless it is known.

        Short work is over before a better estimate of it is worth anything; of a GPU's nothing is measured.
        """
        costs = [plan.estimate.minutes for plan in plans if plan.estimate is not None]
        if self.run.device != "cpu" or sum(costs) < WORTH_MEASURING_MIN:
            return plans
        before, self.pace = self.pace, self.dag.pace(self.reporter.info)
        factor = self.pace / before
        return [
            plan if plan.estimate is None else replace(plan, estimate=plan.estimate.at_pace(factor))
            for plan in plans
        ]

    def estimate(self, name: str, done: Mapping[str, Manifest]) -> Estimate:
        """Rough cost of ``name`` on this machine, from its settings and the finished stages before it."""
        return self._estimate(name, done).at_pace(self.pace)

    def _estimate(self, name: str, done: Mapping[str, Manifest]) -> Estimate:
        known = (name, *done)
        if known in self._estimates:
            return self._estimates[known]
        stage = self.dag.load(name)
        inputs, expected = {}, {}
        for upstream in stage.INPUTS:
            if upstream in done:
                inputs[upstream] = self.store.folder(upstream, done[upstream].key)
            else:
                expected[upstream] = self._estimate(upstream, done)
        context = self.context(name, inputs, WorkFolder(self.store.root / "work" / "estimate"))
        self._estimates[known] = stage.estimate(replace(context, expected=expected))
        return self._estimates[known]

    def context(self, name: str, inputs: Mapping[str, Path], work: WorkFolder) -> StageContext[Any]:
        """All that the stage ``name`` is told."""
        return StageContext(
            config=self.run.config.sections[name],
            settings={other: self.run.config.sections[other] for other in self.dag.load(name).SETTINGS},
            source=self.run.source,
            inputs=inputs,
            externals=self._externals(name),
            out=work.out,
            checkpoints=work.checkpoints,
            cache=self.store.cache_folder(name),
            seed=self.run.config.seed,
            device=self.run.device,
            threads=self.threads,
            reporter=self.reporter,
        )

    def outdated(self) -> list[str]:
        """Stages whose results the run shows although its settings or inputs are others now, in order.

        Results of an older version of the program or of a library are not outdated.
        """
        shown: dict[str, Manifest] = {}
        for name in self.dag.names:
            manifest = linked_manifest(self.run.folder, name)
            if manifest is None or manifest.stage != name:
                continue
            whole = all(upstream in shown for upstream in self.dag.load(name).INPUTS)
            if whole and self._with_present_settings(manifest, shown) == manifest.parts:
                shown[name] = manifest
        return [name for name in self.dag.names if name not in shown]

    def _with_present_settings(self, manifest: Manifest, shown: Mapping[str, Manifest]) -> KeyParts:
        """The parts of ``manifest`` with the settings and inputs that its stage has now."""
        name, parts = manifest.stage, manifest.parts
        digests = self.external_digests(name)
        return parts.model_copy(
            update={
                "config": _known(
                    stage_key_config(self.dag.load(name), name, self.run.config.sections), parts.config
                ),
                "seed": self.run.config.seed,
                "inputs": _known(self.inputs(name, shown)[0], parts.inputs),
                "externals": _known({role: tree_digest(digests[role]) for role in digests}, parts.externals),
            }
        )

    def plan(self, until: str | None = None, force: tuple[str, ...] = ()) -> list[StagePlan]:
        """The state of each stage up to ``until``.

        Raises InputError when an external of any of them cannot be read: better now than after hours of work.
        """
        plans: list[StagePlan] = []
        done: dict[str, Manifest] = {}
        for name in self.dag.until(until):
            waits_for = [upstream for upstream in self.dag.load(name).INPUTS if upstream not in done]
            if waits_for:
                self.external_digests(name)
                reason = f"waits for {', '.join(waits_for)}"
                plans.append(StagePlan(name, "missing", (reason,), self.estimate(name, done)))
                continue
            stage_key = self.stage_key(name, done)
            entry = self.store.find(name, stage_key.key)
            usable = entry.usable if entry is not None else None
            if name in force or usable is None:
                reasons = ("forced",) if name in force else self.reasons(stage_key, entry)
                plans.append(StagePlan(name, "missing", reasons, self.estimate(name, done), stage_key))
            elif usable.missing:
                plans.append(StagePlan(name, "partial", usable.missing, self.estimate(name, done), stage_key))
            else:
                done[name] = usable
                plans.append(StagePlan(name, "done", (), None, stage_key, usable))
        return plans


def _known(now: Mapping[str, Any], before: Mapping[str, Any]) -> dict[str, Any]:
    """``before`` with the values of ``now``. A name that only one of them has came or went with a version of
    the program.
    """
    return {
        name: _known(now[name], value)
        if isinstance(value, Mapping) and isinstance(now.get(name), Mapping)
        else now.get(name, value)
        for name, value in before.items()
    }


def redo_lines(plans: list[StagePlan]) -> list[str]:
    """What of an existing run would be made again, and why; none where nothing is there yet."""
    lines = [
        f"{plan.stage} is made again: {'; '.join(plan.reasons)}"
        for plan in plans
        if plan.stage_key is not None and plan.state != "done" and plan.reasons != (NOT_MADE,)
    ]
    after = [plan.stage for plan in plans if plan.stage_key is None]
    return [*lines, f"then {', '.join(after)}"] if lines and after else lines


def cost_line(plans: list[StagePlan]) -> str:
    """One line of expected minutes, memory and disk for each stage with work to do; "" without work."""
    costs = [(plan.stage, plan.estimate) for plan in plans if plan.estimate is not None]
    if not costs:
        return ""
    words = [
        f"{stage} {_time(cost.minutes)} {cost.memory_gb:.1f} GB, disk {_size(cost.disk_gb)}"
        for stage, cost in costs
    ]
    return f"expected about {_time(sum(cost.minutes for _, cost in costs))}: " + "; ".join(words)


def check_disk(plans: list[StagePlan], store: Path) -> None:
    """Raise StoreError when the disk of ``store`` has less free space than the stages to run will fill."""
    needed = sum(plan.estimate.disk_gb for plan in plans if plan.estimate is not None)
    place = next(folder for folder in (store, *store.parents) if folder.exists())
    disk = shutil.disk_usage(place)
    free = disk.free / 1e9
    if disk.total and needed > free:  # a place without a disk (/proc) is told of when it is written to
        raise StoreError(
            f"the run needs about {_size(needed)} of disk, {_size(free)} are free at {place}",
            hint="free some space (cleargs gc), choose another --store, or lower ingest.max_frames",
        )


def check_address_space() -> None:
    """Raise InputError where a limit on addresses (``ulimit -v``) does not even let the libraries in: some of
    them wait for ever then.
    """
    limit, _ = resource.getrlimit(resource.RLIMIT_AS)
    if limit != resource.RLIM_INFINITY and limit < MIN_ADDRESS_SPACE_GB * 1e9:
        raise InputError(
            f"this shell allows a process {_size(limit / 1e9)} of addresses; the libraries alone need "
            f"{MIN_ADDRESS_SPACE_GB:.0f} GB",
            hint="raise the limit: ulimit -v unlimited",
        )


def _time(minutes: float) -> str:
    return f"{minutes:.1f} min" if minutes >= 0.5 else f"{60 * minutes:.0f} s"


def _size(gigabytes: float) -> str:
    return f"{gigabytes:.1f} GB" if gigabytes >= 1 else f"{1000 * gigabytes:.0f} MB"
