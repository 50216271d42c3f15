"""Plan a run: for each stage, find its results in the store, or say what changed and estimate the cost."""

from __future__ import annotations

import resource
import shutil
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

from cleargs.digest import tree_digest
from cleargs.errors import InputError, StoreError
from cleargs.files import External
from cleargs.manifest import KeyParts, Manifest, last_shown, linked_manifest
from cleargs.packed import require_images
from cleargs.pipeline.keys import differences, library_versions, plugin_versions, stage_key_config
from cleargs.pipeline.outputs import Place, own_places
from cleargs.pipeline.run_file import RunSpec
from cleargs.pipeline.stage import Estimate, StageContext
from cleargs.pipeline.stages import Stages
from cleargs.pipeline.store import Entry, Store, WorkFolder
from cleargs.progress import Reporter
from cleargs.safe_io import require_utf8

MIN_ADDRESS_SPACE_GB = 2.0
"""Address space that planning needs, because the libraries reserve it when they are imported."""

MORE_ADDRESS_SPACE_GB = 3.5
"""Address space that a run needs in addition to the estimated memory, for libraries and stacks of threads.
Measured with 12 frames of 240x136 (estimate 1.1 GB): a limit of 4.0 GB is too low, and 4.5 GB are enough."""

STEADY_S = 20.0
"""Seconds that are added to measured and expected times before they are compared."""

NO_RESULTS = "no results yet"
"""Reason of a stage that never had results in this run."""

Origins = dict[str, dict[str, str]]
"""Input ("STAGE/PATH") or role of an external -> relative path of a file -> its digest."""

State = Literal["done", "partial", "missing", "outdated", "running", "packed"]
"""``partial``: the results exist, but the stage could not make all of them. ``packed``: those that
``cleargs pack`` took exist, and nothing can be run."""


@dataclass(frozen=True)
class StageKey:
    """The key of a stage, and the files behind it."""

    parts: KeyParts
    origins: Origins
    inputs: Mapping[str, Path]
    """Upstream stage -> its finished folder."""
    inherited: tuple[str, ...]
    """Outputs that are missing upstream, one line each."""


@dataclass(frozen=True)
class StagePlan:
    """The state of one stage of a run."""

    stage: str
    state: State
    reasons: tuple[str, ...]
    """Reasons why it is missing, or outputs that a partial stage lacks."""
    estimate: Estimate | None = None
    """Cost of the work to do; None if it is done."""
    stage_key: StageKey | None = None
    """None until the upstream stages are done: the key depends on the content of their outputs."""
    manifest: Manifest | None = None
    """Manifest of a stage that is done."""

    @property
    def key(self) -> str | None:
        """The key of the stage; None until the upstream stages are done."""
        return self.stage_key.parts.key if self.stage_key is not None else None


@dataclass
class Planner:
    """Computes keys and compares them with the store and the run folder. Writes nothing."""

    dag: Stages
    run: RunSpec
    store: Store
    threads: int
    reporter: Reporter
    _estimates: dict[tuple[str, ...], Estimate] = field(default_factory=dict, repr=False)

    def stage_key(self, name: str, done: Mapping[str, Manifest], *, rehash: bool = False) -> StageKey:
        """Return the key of the stage ``name``, whose upstream stages have the manifests ``done``.

        With ``rehash``, every external file is read again instead of using digests from the memo. Raises
        InputError if an external (the capture, a model) cannot be read.
        """
        stage, config = self.dag.load(name), self.run.config.effective[name]
        inputs, origins = self.inputs(name, done)
        digests = self.external_digests(name, rehash=rehash)
        origins.update(digests)
        parts = KeyParts(
            stage=name,
            version=stage.VERSION,
            config=stage_key_config(stage, name, self.run.config.effective),
            inputs=inputs,
            externals={role: tree_digest(files) for role, files in digests.items()},
            seed=self.run.config.seed,
            device=self.run.device,
            libraries=library_versions(stage, self.run.device, config) | plugin_versions(config),
        )
        folders = {upstream: self.store.folder(upstream, done[upstream].key) for upstream in stage.INPUTS}
        inherited: dict[str, None] = {}  # an ordered set
        for upstream in stage.INPUTS:
            inherited |= dict.fromkeys(done[upstream].inherited)
            inherited |= dict.fromkeys(f"{upstream}: {missing}" for missing in done[upstream].missing)
        return StageKey(parts, origins, folders, tuple(inherited))

    def inputs(
        self, name: str, done: Mapping[str, Manifest]
    ) -> tuple[dict[str, dict[str, str | None]], Origins]:
        """Return upstream stage -> path -> digest of the inputs of ``name``, and digests of single files."""
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
        return self.dag.load(name).externals(self.run.config.effective[name], self.run.source)

    def external_digests(self, name: str, *, rehash: bool = False) -> dict[str, dict[str, str]]:
        """Return role -> relative path -> digest of the files that ``name`` reads outside the store.

        With ``rehash``, every file is read again. Raises InputError if one cannot be read, if the run or its
        store is inside the input, or if the input is one of the files that the run writes.
        """
        places = self._externals(name)
        for folder in (self.run.folder, self.run.source, self.store.root):
            require_utf8(folder)
        self._keep_apart(places)
        return {role: self.store.memo.digests_of(place, rehash=rehash) for role, place in places.items()}

    def _keep_apart(self, places: Mapping[str, External]) -> None:
        """Raise InputError unless the run, its store and the ``places`` of its inputs (by role) are apart.

        The run may be next to what a folder holds (``images/``, videos), but not among its photographs.
        """
        run, source, hint = self.run.folder, self.run.source, "choose a folder next to the input with -o"
        given = Place(source, hard_links=False)
        within = Place(run).is_inside(source)
        if within and given.is_inside(run):
            raise InputError(f"the run folder {run} is the input itself", hint=hint)
        folders = [place for place in places.values() if isinstance(place, Path)]
        listed = [(role, place) for role, place in places.items() if isinstance(place, Mapping)]
        around = {(role, file.parent) for role, files in listed for file in files.values()}
        folders += {folder for role, folder in around if role == "capture" or folder != source}
        for place in folders if within else (*folders, source):
            for what, folder, option in (("run folder", run, "-o"), ("store", self.store.root, "--store")):
                if Place(folder).is_inside(place):
                    hint = f"choose a folder next to the input with {option}"
                    raise InputError(f"the {what} {folder} is inside the input {place}", hint=hint)
        for place in filter(given.is_inside, own_places(run, self.dag, self.store.root)):
            raise InputError(f"the run would replace its input {source}: it writes {place}", hint=hint)

    def reasons(self, stage_key: StageKey, entry: Entry | None) -> tuple[str, ...]:
        """Return the reasons why there are no complete results for ``stage_key``, for users."""
        if entry is not None and entry.damage is not None:
            return (f"damaged: {entry.damage}",)
        if entry is not None and entry.usable is not None:
            return tuple(f"retry, missing so far: {missing}" for missing in entry.usable.missing)
        before = last_shown(self.run.folder, stage_key.parts.stage)
        if before is None:
            return (NO_RESULTS,)
        changes = differences(before.parts, stage_key.parts, before.origins, stage_key.origins)
        return tuple(changes) or ("its results were removed from the store",)

    def pace_of(self, made: Mapping[str, Manifest]) -> float:
        """Return the time that the stages ``made`` took by their estimates, at least a half.

        Short stages count little, and so do those whose results were quickly at hand.
        """
        taken = expected = STEADY_S
        for name, manifest in made.items():
            before = {one: made[one] for one in self.dag.load(name).INPUTS if one in made}
            taken += manifest.seconds
            expected += 60.0 * self.estimate(name, before).minutes
        return max(0.5, taken / expected)

    def estimate(self, name: str, done: Mapping[str, Manifest]) -> Estimate:
        """Estimate the cost of ``name`` from its settings and finished upstream stages."""
        known = (name, *done)
        if known in self._estimates:
            return self._estimates[known]
        stage = self.dag.load(name)
        inputs, expected = {}, {}
        for upstream in stage.INPUTS:
            if upstream in done:
                inputs[upstream] = self.store.folder(upstream, done[upstream].key)
            else:
                expected[upstream] = self.estimate(upstream, done)
        context = self.context(name, inputs, WorkFolder(self.store.root / "work" / "estimate"))
        self._estimates[known] = stage.estimate(replace(context, expected=expected))
        return self._estimates[known]

    def context(self, name: str, inputs: Mapping[str, Path], work: WorkFolder) -> StageContext[Any]:
        """Return the context that the stage ``name`` receives."""
        return StageContext(
            config=self.run.config.effective[name],
            settings={other: self.run.config.effective[other] for other in self.dag.load(name).SETTINGS},
            source=self.run.source,
            inputs=inputs,
            externals=self._externals(name),
            out=work.out,
            checkpoints=work.checkpoints,
            cache=self.store.root / "kept" / name,
            seed=self.run.config.seed,
            device=self.run.device,
            threads=self.threads,
            reporter=self.reporter,
        )

    def outdated(self) -> list[str]:
        """Return the stages that the run must not show any more: their settings or inputs have changed.

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
        """Return the parts of ``manifest`` with the current settings and inputs of its stage."""
        name = manifest.stage
        digests = self.external_digests(name)
        now = {
            "config": stage_key_config(self.dag.load(name), name, self.run.config.effective),
            "seed": self.run.config.seed,
            "inputs": self.inputs(name, shown)[0],
            "externals": {role: tree_digest(files) for role, files in digests.items()},
        }
        return manifest.parts.model_copy(update=_updated(now, dict(manifest.parts)))

    def plan(self, until: str | None = None, force: tuple[str, ...] = ()) -> list[StagePlan]:
        """Return the state of each stage up to and including ``until``; stages in ``force`` count as missing.

        Raises InputError if an external of any stage cannot be read: better now than after hours of work.
        """
        require_images(self.run.folder, "continuing it")
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
            entry = self.store.find(name, stage_key.parts.key)
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


def _updated(now: Mapping[str, Any], before: Mapping[str, Any]) -> dict[str, Any]:
    """Return ``before`` with the values of ``now``, for the names that ``before`` has.

    A name that only one of them has belongs to another version of the program, which is not a change.
    """
    return {
        name: _updated(now[name], value)
        if isinstance(value, Mapping) and isinstance(now.get(name), Mapping)
        else now.get(name, value)
        for name, value in before.items()
    }


def rerun_lines(plans: list[StagePlan]) -> list[str]:
    """Return one line per stage whose results must be replaced, with the reasons. Empty for a new run."""
    lines = [
        f"{plan.stage} runs again: {'; '.join(plan.reasons)}"
        for plan in plans
        if plan.stage_key is not None and plan.state != "done" and plan.reasons != (NO_RESULTS,)
    ]
    after = [plan.stage for plan in plans if plan.stage_key is None]
    return [*lines, f"then: {', '.join(after)}"] if lines and after else lines


def cost_line(plans: list[StagePlan]) -> str:
    """Return one line with the expected time, memory and disk, and the time of each stage with work to do.

    It is empty if no stage has work: those that make no repairs take no time.
    """
    costs = [(plan.stage, plan.estimate) for plan in plans if plan.estimate and plan.estimate.minutes]
    if not costs:
        return ""
    whole = Estimate(
        sum(cost.minutes for _, cost in costs),
        max(cost.memory_gb for _, cost in costs),
        sum(cost.disk_gb for _, cost in costs),
    )
    stages = ", ".join(f"{stage} {_time(cost.minutes)}" for stage, cost in costs)
    return f"estimate: about {cost_text(whole)} ({stages})"


def cost_text(cost: Estimate) -> str:
    return f"{_time(cost.minutes)}, {cost.memory_gb:.1f} GB memory, {_size(cost.disk_gb)} disk"


def check_disk(plans: list[StagePlan], store: Path) -> None:
    """Raise StoreError if the disk of ``store`` has less free space than the stages to run need."""
    needed = sum(plan.estimate.disk_gb for plan in plans if plan.estimate is not None)
    place = next(folder for folder in (store, *store.parents) if folder.exists())
    disk = shutil.disk_usage(place)
    free = disk.free / 1e9
    if disk.total and needed > free:  # /proc and the like have no size; writing there fails later
        raise StoreError(
            f"the run needs about {_size(needed)} of disk, and {place} has {_size(free)} free",
            hint="free some space (cleargs gc), choose another --store, or lower ingest.max_frames",
        )


def check_address_space(plans: list[StagePlan] | None = None) -> None:
    """Raise InputError if the limit on address space (``ulimit -v``) is too low for the stages to run.

    Without ``plans``, it must be enough to import the libraries, some of which would hang.
    """
    limit, _ = resource.getrlimit(resource.RLIMIT_AS)
    costs = [plan.estimate.memory_gb for plan in plans or () if plan.estimate is not None]
    needed = MORE_ADDRESS_SPACE_GB + max(costs) if costs else MIN_ADDRESS_SPACE_GB
    if limit != resource.RLIM_INFINITY and limit < needed * 1e9:
        raise InputError(
            f"the limit on virtual memory (ulimit -v) is {_size(limit / 1e9)}; {_size(needed)} are needed",
            hint="raise the limit: ulimit -v unlimited",
        )


def _time(minutes: float) -> str:
    return f"{minutes:.1f} min" if minutes >= 0.5 else f"{60 * minutes:.0f} s"


def _size(gigabytes: float) -> str:
    return f"{gigabytes:.1f} GB" if gigabytes >= 1 else f"{1000 * gigabytes:.0f} MB"
