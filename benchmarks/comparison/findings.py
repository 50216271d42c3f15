"""All that a comparison found: the cells of its tables, the roles of the frames, and how RIVR chose."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, TypeAdapter, ValidationError

from benchmarks.comparison.cells import Cell, Cells
from benchmarks.comparison.choices import ChoiceRow, Choices, judge_choices
from benchmarks.comparison.roles import Roles, count_roles
from benchmarks.comparison.scenes import EVALUATION_VERSION, Made, SceneRecipe, judge
from benchmarks.comparison.tables import Results
from cleargs.digest import json_digest
from cleargs.errors import CleargsError, InputError
from cleargs.evaluate.config import EvalOptions
from cleargs.files import write_bytes
from cleargs.pipeline.store import Store
from cleargs.progress import Reporter
from cleargs.safe_io import read_bytes

T = TypeVar("T", Cell, Roles, Choices)


@dataclass
class Compared:
    """All scenes of a comparison, judged."""

    scenes: list[Made] = field(default_factory=list)
    cells: list[Cell] = field(default_factory=list)
    roles: list[Roles] = field(default_factory=list)
    choices: list[Choices] = field(default_factory=list)
    failures: list[str] = field(default_factory=list)

    @property
    def results(self) -> Results:
        return Results(Cells(self.cells), self.roles, self.choices)

    @property
    def labels(self) -> dict[str, str]:
        """Variant -> what it is called."""
        return {scene.variant.name: scene.variant.label for scene in self.scenes}

    def add(self, other: Compared) -> None:
        """Take over what ``other`` found."""
        self.scenes += other.scenes
        self.cells += other.cells
        self.roles += other.roles
        self.choices += other.choices
        self.failures += other.failures

    def in_columns(self, suffix: str) -> Compared:
        """The same in columns of their own, for a comparison of comparisons."""

        def moved(items: Sequence[T]) -> list[T]:
            return [item.model_copy(update={"column": f"{item.column} {suffix}"}) for item in items]

        cells, roles, choices = moved(self.cells), moved(self.roles), moved(self.choices)
        return Compared(self.scenes, cells, roles, choices, self.failures)

    def document(self) -> dict[str, Any]:
        """``comparison.json``."""
        lists: dict[str, Sequence[BaseModel]] = {
            "cells": self.cells,
            "roles": self.roles,
            "choices": self.choices,
        }
        return {
            # By way of text, where infinite figures are strings.
            **{name: [json.loads(item.model_dump_json()) for item in found] for name, found in lists.items()},
            "failures": self.failures,
        }


def compare_scenes(
    out: Path, made: Iterable[Made | str], recipe: SceneRecipe, store: Store, reporter: Reporter
) -> Compared:
    """Judge every scene; a line in place of one says why it could not be made.

    One that cannot be judged is named among the failures and ends none of the others.
    """
    found = Compared()
    for scene in made:
        if isinstance(scene, str):
            reporter.warn(scene)
            found.failures.append(scene)
            continue
        try:
            cells, roles = judge(out, scene, recipe, store, reporter), roles_of(scene)
            choices = choices_of(out, scene, store)
        except CleargsError as error:
            reporter.warn(f"{scene.sample.name}, {scene.variant.label}: {error}")
            found.failures.append(f"{scene.sample.name}, {scene.variant.label}: {error}")
            continue
        found.cells += cells
        found.roles.append(roles)
        if choices is not None:
            found.choices.append(choices)
        found.scenes.append(scene)
    if not found.cells:
        raise InputError("nothing could be compared", hint="the warnings above say why")
    return found


def roles_of(made: Made) -> Roles:
    """The training frames of a scene by role. Raises StoreError."""
    return Roles(
        column=made.sample.column,
        sample=made.sample.name,
        variant=made.variant.name,
        frames=count_roles(made.run / "rva"),
    )


def choices_of(out: Path, made: Made, store: Store) -> Choices | None:
    """How RIVR chose, against the truth; None where there is no RIVR or no truth. Kept by content."""
    from cleargs.evaluate.metrics import load_metrics

    rivr = next((manifest for manifest in made.manifests if manifest.stage == "rivr"), None)
    truth = made.sample.capture / "truth"
    if rivr is None or not truth.is_dir():
        return None
    distances = load_metrics(EvalOptions(lpips=("alex",), scorers=())).lpips
    parts = {
        "version": EVALUATION_VERSION,
        "rivr": rivr.digest,
        "truth": store.memo.digests_of(truth),
        "metrics": sorted(distances),
    }
    path = out / "choices" / f"{json_digest(parts)}.json"
    try:
        rows = TypeAdapter(tuple[ChoiceRow, ...]).validate_json(read_bytes(path))
    except (OSError, ValidationError):  # not made yet, or damaged
        rows = tuple(judge_choices(made.run, made.sample.capture, distances.get("lpips_alex")))
        path.parent.mkdir(parents=True, exist_ok=True)
        write_bytes(path, TypeAdapter(tuple[ChoiceRow, ...]).dump_json(rows))
    if not rows:
        return None
    return Choices(column=made.sample.column, sample=made.sample.name, variant=made.variant.name, rows=rows)
