"""How a run came about: its stages, the settings that are not the defaults, versions, the command."""

from __future__ import annotations

import os
import shlex
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import tomli_w
from pydantic import BaseModel

from cleargs.manifest import Manifest
from cleargs.pipeline.config import Config, load_config, recipe_names
from cleargs.pipeline.dag import Dag
from cleargs.pipeline.plan import StagePlan
from cleargs.pipeline.run_file import Run
from cleargs.report.words import duration, size

STATES = {"done": "up to date", "partial": "done in part", "missing": "to be made"}


class Setting(NamedTuple):
    """A setting that is not its default."""

    name: str
    value: str
    default: str
    meaning: str


class StageRow(NamedTuple):
    """What one stage cost, and whether its results are those of today's settings and input."""

    name: str
    state: str
    reasons: tuple[str, ...]
    how: str
    """What the last ``cleargs run`` did: made, found, or nothing known."""
    time: str
    share: float
    """Of the time of all stages, 0 to 1."""
    size: str
    key: str


def stage_rows(
    names: Sequence[str],
    manifests: Mapping[str, Manifest],
    plans: Mapping[str, StagePlan],
    last: Mapping[str, str],
) -> list[StageRow]:
    """One row for every stage; ``last``: stage -> ``made`` or ``found``, as the last run had it."""
    total = sum(manifest.seconds for manifest in manifests.values()) or 1.0
    rows = []
    for name in names:
        manifest, plan = manifests.get(name), plans.get(name)
        rows.append(
            StageRow(
                name,
                STATES[plan.state] if plan else "unknown",
                plan.reasons if plan else (),
                {"made": "made anew", "found": "found in the store"}.get(last.get(name, ""), ""),
                duration(manifest.seconds) if manifest else "",
                manifest.seconds / total if manifest else 0.0,
                size(manifest.bytes) if manifest else "",
                manifest.key[:12] if manifest else "",
            )
        )
    return rows


def changed_settings(config: Config) -> list[Setting]:
    """All settings of the stages that differ from their models' defaults, nested ones by their full name."""
    return [
        Setting(f"{section}.{name}", _toml(value), _toml(default), meaning)
        for section, model in config.sections.items()
        for name, value, default, meaning in _changes(model, type(model)())
    ]


def _changes(model: BaseModel, default: BaseModel) -> Iterator[tuple[str, Any, Any, str]]:
    for name, field in type(model).model_fields.items():
        value, usual = getattr(model, name), getattr(default, name)
        if isinstance(value, BaseModel) and isinstance(usual, type(value)):
            yield from ((f"{name}.{inner}", *rest) for inner, *rest in _changes(value, usual))
        elif value != usual:
            yield name, value, usual, field.description or ""


def command(run: Run, dag: Dag) -> str:
    """The ``cleargs run`` that makes this run, called beside its folder: the nearest recipe, the rest set."""
    wanted = _flat(run.config.document())
    candidates = []
    for recipe in ("default", *(name for name in recipe_names() if name != "default")):
        have = _flat(load_config(dag, recipe).document())
        changed = {name: value for name, value in wanted.items() if have.get(name) != value}
        candidates.append((len(changed), recipe, changed))
    _, recipe, changed = min(candidates, key=lambda item: item[0])
    source = os.path.relpath(run.source, run.folder.parent)
    words = ["cleargs", "run", source, "-o", run.folder.name]
    words += ["--workflow", recipe] if recipe != "default" else []
    words += ["--seed", str(changed.pop("seed"))] if "seed" in changed else []
    for name, value in changed.items():
        words += ["--set", f"{name}={value if isinstance(value, str) else _toml(value)}"]
    return shlex.join(words)


def _flat(document: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    found: dict[str, Any] = {}
    for name, value in document.items():
        if isinstance(value, Mapping):
            found |= _flat(value, f"{prefix}{name}.")
        else:
            found[prefix + name] = value
    return found


def _toml(value: Any) -> str:
    """``value`` as TOML writes it; "unset" for None."""
    if value is None:
        return "unset"
    if isinstance(value, BaseModel):
        value = value.model_dump(mode="json", exclude_none=True)
    if isinstance(value, tuple):
        value = list(value)
    return " ".join(tomli_w.dumps({"v": value}).removeprefix("v = ").split())


def versions(manifests: Mapping[str, Manifest]) -> dict[str, str]:
    """Program or library -> version, of all stages together."""
    found: dict[str, str] = {}
    for manifest in manifests.values():
        found |= {**manifest.versions, **{name: str(v) for name, v in manifest.parts.libraries.items()}}
    return found
