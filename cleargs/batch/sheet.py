"""A sheet of scenes, TOML or CSV: each scene is a call of ``cleargs run``."""

from __future__ import annotations

import csv
import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field, StringConstraints, ValidationError

from cleargs.base_model import FrozenModel
from cleargs.errors import InputError
from cleargs.pipeline.config import merge, parse_toml
from cleargs.pipeline.settings import flattened
from cleargs.safe_io import FAULTS, cause, read_text

NAMES = "letters, digits, and _ . - after the first, at most 100"
PLAIN = ("name", "input", "recipe")
"""Columns of a CSV sheet that are no settings."""


class SheetError(InputError):
    """A sheet with mistakes, one line each, which names the line or the scene."""

    def __init__(self, path: Path, problems: list[str]) -> None:
        mistakes = "1 mistake" if len(problems) == 1 else f"{len(problems)} mistakes"
        super().__init__(f"{path.name} has {mistakes}", hint="correct the scenes above; no scene was started")
        self.problems = problems


class SheetRow(FrozenModel):
    """One scene as the sheet gives it, the sheet's own defaults filled in."""

    name: Annotated[str, StringConstraints(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,99}$")] = Field(
        description=NAMES
    )
    input: Annotated[str, StringConstraints(strip_whitespace=True, min_length=1)]
    recipe: str = "default"
    set: dict[str, str] = Field({})
    """Setting -> its value in TOML."""


@dataclass(frozen=True)
class SceneJob:
    """One scene to bring through the stages."""

    name: str
    source: Path
    """Absolute."""
    recipe: str
    """A name, or the absolute path of a TOML file."""
    overrides: tuple[str, ...]
    """Settings as ``--set`` takes them."""
    where: str
    """The place in the sheet."""


def read_scenes(path: Path) -> list[SceneJob]:
    """Return the scenes of the sheet ``path``: a CSV where its name ends so, TOML otherwise.

    Settings and inputs are not checked. Raises SheetError with all mistakes of form, InputError for no sheet.
    """
    try:
        text = read_text(path)
    except FAULTS as error:
        raise InputError(f"cannot read {path}: {cause(error)}", hint="give a sheet, TOML or CSV") from error
    scenes: dict[str, SceneJob] = {}
    folder, problems = path.absolute().parent, []
    rows = _csv_rows(path, text) if path.suffix.lower() == ".csv" else _toml_rows(path, text)
    for where, values in rows:
        try:
            row = SheetRow.model_validate(values)
        except ValidationError as error:
            problems += [f"{where}: {_problem(found)}" for found in error.errors(include_url=False)]
            continue
        if row.name in scenes:
            problems.append(f"{where}: the name {row.name!r} is taken by {scenes[row.name].where}")
        recipe = str(folder / row.recipe) if row.recipe.endswith(".toml") else row.recipe
        overrides = tuple(f"{name}={value}" for name, value in row.set.items())
        scenes[row.name] = SceneJob(row.name, folder / row.input, recipe, overrides, where)
    if problems:
        raise SheetError(path, problems)
    if not scenes:
        raise InputError(f"{path} lists no scene", hint='write [[scene]], name = "room", input = "room.mp4"')
    return list(scenes.values())


def _problem(found: Any) -> str:
    """Return one complaint of pydantic in a line."""
    name = ".".join(map(str, found["loc"]))
    match found["type"]:
        case "missing":
            return f"the scene has no {name}"
        case "extra_forbidden":
            return f"a scene has no field {name!r}; known: {', '.join(SheetRow.model_fields)}"
        case "string_pattern_mismatch":
            return f"the name {found['input']!r} cannot be used; allowed: {NAMES}"
        case _:
            return f"{name}: {found['msg']}"


def _toml_rows(path: Path, text: str) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield the ``[[scene]]`` tables; ``recipe`` and ``[set]`` above them hold for all scenes."""
    document = parse_toml(text, path.name)
    scenes = document.pop("scene", [])
    if not isinstance(scenes, list) or not all(isinstance(scene, dict) for scene in scenes):
        raise InputError(f"{path.name}: scene is no list of tables", hint="write each scene as [[scene]]")
    for number, scene in enumerate(scenes, 1):
        values = merge(document, scene)
        if isinstance(given := values.get("set"), dict):  # JSON's spelling of a value is TOML's too
            values["set"] = {
                name: json.dumps(value, ensure_ascii=False, default=str) for name, value in flattened(given)
            }
        yield f"{path.name}, scene {scene.get('name', number)}", values


def _csv_rows(path: Path, text: str) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield the rows. A column that is not in `PLAIN` is a setting; an empty cell says nothing."""
    reader = csv.DictReader(text.splitlines(keepends=True), restkey="more cells than columns", strict=True)
    try:
        columns = [column.strip() for column in reader.fieldnames or ()]
        named = [column for column in columns if column]
        if not {"name", "input"} <= set(named) or len(set(named)) < len(named):
            raise InputError(
                f"{path.name}: the first line has to name each column once, with name and input among them",
                hint="write name,input with a comma between them",
            )
        reader.fieldnames = columns
        for row in reader:
            given = {name: str(cell).strip() for name, cell in row.items() if cell and str(cell).strip()}
            if given:
                values: dict[str, Any] = {name: given.pop(name) for name in PLAIN if name in given}
                yield f"{path.name}, line {reader.line_num}", {**values, "set": given}
    except csv.Error as error:
        where = f"{path.name}, line {reader.reader.line_num}"
        raise SheetError(path, [f"{where}: this is no CSV: {error}"]) from error
