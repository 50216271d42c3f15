"""Whether what a run shows was made with the run's settings and inputs: one answer for all who read results.

Stale is a finished stage that was made with other settings, another seed, other files of the capture or other
model weights than the run has now, or from a stage that is stale or not there; and one without its manifest,
or whose files are no longer those that it published.
A newer version of the program or of a library makes nothing stale: `cleargs explain` says what a run would
make again for that reason.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from shlex import quote
from typing import Any

from cleargs.errors import CleargsError, InputError
from cleargs.pipeline.dag import Dag
from cleargs.pipeline.digest import DigestMemo, tree_digest
from cleargs.pipeline.keys import differences, key_config
from cleargs.pipeline.manifest import Manifest, damage, linked_manifest
from cleargs.pipeline.plan import Planner
from cleargs.pipeline.run_file import Run, read_run_file
from cleargs.pipeline.store import Store
from cleargs.progress import SilentReporter

Reasons = tuple[str, ...]


def stale_stages(dag: Dag, run: Run) -> dict[str, Reasons]:
    """Finished stage of ``run`` -> why it is stale; stages that are not finished, or fresh, are left out."""
    with DigestMemo(run.store / "digests.sqlite") as memo:
        planner = Planner(dag, run, Store(run.store, memo), 1, SilentReporter())
        made = {name: found for name in dag.names if (found := linked_manifest(run.folder, name)) is not None}
        unknown = [name for name in dag.names if name not in made and (run.folder / name).exists()]
        stale: dict[str, Reasons] = dict.fromkeys(unknown, ("its manifest is missing or damaged",))
        for name, manifest in made.items():
            upstream = dag.load(name).INPUTS
            absent = [before for before in upstream if before not in made]
            reasons = [] if absent else _changes(planner, manifest, made)
            reasons += [f"it was made from {before}, which is not there" for before in absent]
            old = [before for before in upstream if before in stale]
            reasons += [f"it was made from stale {', '.join(old)}"] if old else []
            if reasons:
                stale[name] = tuple(reasons)
        for name, manifest in made.items():  # last: what was made from it before it was damaged is as it was
            if (fault := damage(run.folder / name, manifest, memo)) is not None:
                stale[name] = (*stale.get(name, ()), fault)
    return {name: stale[name] for name in dag.names if name in stale}


def require_fresh(dag: Dag, folder: Path, stages: Sequence[str], *, stale: bool = False) -> str:
    """Raise InputError where one of ``stages`` of the run in ``folder`` is stale.

    With ``stale`` they are taken all the same: returns the line that says so, "" where all are fresh.
    """
    try:
        run = read_run_file(folder, dag)
        found = stale_stages(dag, run)
    except CleargsError as error:
        if not stale:
            raise
        return f"stale, perhaps: {error}"
    for name in stages:
        if name in found:
            line = f"{name} is stale: {'; '.join(found[name])}"
            if stale:
                return line
            raise InputError(
                line, hint=f"bring it up to date (cleargs run {_quoted(run)}), or insist with --stale"
            )
    return ""


def _quoted(run: Run) -> str:
    return f"{quote(str(run.source))} -o {quote(str(run.folder))}"


def _changes(planner: Planner, manifest: Manifest, made: Mapping[str, Manifest]) -> list[str]:
    """What is different now from what ``manifest`` was made with, in lines for a reader."""
    name, parts = manifest.stage, manifest.parts
    inputs, origins = planner.inputs(name, made)
    digests: dict[str, dict[str, str]] = {}
    with suppress(InputError):  # the capture or a model is gone: nothing says that it was another
        digests = planner.external_digests(name)
    now = parts.model_copy(
        update={
            "config": _known(key_config(planner.run.config.sections[name]), parts.config),
            "seed": planner.run.config.seed,
            "inputs": _known(inputs, parts.inputs),
            "externals": _known(
                {role: tree_digest(files) for role, files in digests.items()}, parts.externals
            ),
        }
    )
    return differences(parts, now, manifest.origins, origins | digests)


def _known(now: Mapping[str, Any], before: Mapping[str, Any]) -> dict[str, Any]:
    """``before`` with the values of ``now``. What only one of them has came or went with a version of the
    program."""
    return {
        name: _known(now[name], value)
        if isinstance(value, Mapping) and isinstance(now.get(name), Mapping)
        else now.get(name, value)
        for name, value in before.items()
    }
