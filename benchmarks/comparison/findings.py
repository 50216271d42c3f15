"""Results of a comparison: the cells of its tables, the roles of the frames and the choices of RIVR."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, TypeAdapter, ValidationError

from benchmarks.comparison.cells import Cell, Cells
from benchmarks.comparison.choices import ChoiceRow, Choices, measure_choices
from benchmarks.comparison.roles import Roles, count_roles
from benchmarks.comparison.scenes import EVALUATION_VERSION, FinishedScene, SceneRecipe, evaluate_views
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
class Comparison:
    """Evaluated scenes of a comparison, and the reasons why others are missing."""

    scenes: list[FinishedScene] = field(default_factory=list)
    cells: list[Cell] = field(default_factory=list)
    roles: list[Roles] = field(default_factory=list)
    choices: list[Choices] = field(default_factory=list)
    failures: list[str] = field(default_factory=list)

    @property
    def results(self) -> Results:
        return Results(Cells(self.cells), self.roles, self.choices)

    @property
    def labels(self) -> dict[str, str]:
        """Variant -> label in tables."""
        return {scene.variant.name: scene.variant.label for scene in self.scenes}

    def add(self, other: Comparison) -> None:
        """Add the results of ``other``."""
        self.scenes += other.scenes
        self.cells += other.cells
        self.roles += other.roles
        self.choices += other.choices
        self.failures += other.failures

    def in_columns(self, suffix: str) -> Comparison:
        """Return a copy with ``suffix`` on the name of each column, to put comparisons into one table."""

        def renamed(items: Sequence[T]) -> list[T]:
            return [item.model_copy(update={"column": f"{item.column} {suffix}"}) for item in items]

        cells, roles, choices = renamed(self.cells), renamed(self.roles), renamed(self.choices)
        return Comparison(self.scenes, cells, roles, choices, self.failures)

    def document(self) -> dict[str, Any]:
        """Return the content of ``comparison.json``."""
        lists: dict[str, Sequence[BaseModel]] = {
            "cells": self.cells,
            "roles": self.roles,
            "choices": self.choices,
        }
        return {
            # pydantic's JSON has strings for infinite figures.
            **{name: [json.loads(item.model_dump_json()) for item in found] for name, found in lists.items()},
            "failures": self.failures,
        }


def compare_scenes(
    out: Path, scenes: Iterable[FinishedScene | str], recipe: SceneRecipe, store: Store, reporter: Reporter
) -> Comparison:
    """Evaluate scenes.

    Args:
        out: Folder of the comparison.
        scenes: Scenes, or a line with the reason for each missing one.
        recipe: Settings that all scenes share.
        store: The store of the runs.
        reporter: Receives progress and warnings.

    Returns:
        Results of all scenes that could be evaluated. The others are among its failures.

    Raises:
        InputError: No scene could be evaluated.
    """
    found = Comparison()
    for scene in scenes:
        if isinstance(scene, str):
            reporter.warn(scene)
            found.failures.append(scene)
            continue
        try:
            cells, roles = evaluate_views(out, scene, recipe, store, reporter), roles_of(scene)
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
        raise InputError("no scene could be evaluated", hint="see the warnings above for the reasons")
    return found


def roles_of(scene: FinishedScene) -> Roles:
    """Count the training frames of a scene by role; raise StoreError if the table is damaged."""
    return Roles(
        column=scene.sample.column,
        sample=scene.sample.name,
        variant=scene.variant.name,
        frames=count_roles(scene.run / "rva"),
    )


def choices_of(out: Path, scene: FinishedScene, store: Store) -> Choices | None:
    """Return the choices of RIVR, or None without RIVR or truth; results are cached by content."""
    from cleargs.evaluate.metrics import load_metrics

    rivr = next((manifest for manifest in scene.manifests if manifest.stage == "rivr"), None)
    truth = scene.sample.capture / "truth"
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
        rows = tuple(measure_choices(scene.run, scene.sample.capture, distances.get("lpips_alex")))
        path.parent.mkdir(parents=True, exist_ok=True)
        write_bytes(path, TypeAdapter(tuple[ChoiceRow, ...]).dump_json(rows))
    if not rows:
        return None
    return Choices(
        column=scene.sample.column, sample=scene.sample.name, variant=scene.variant.name, rows=rows
    )
