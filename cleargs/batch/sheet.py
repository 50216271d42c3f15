"""Read a sheet of scenes (TOML or CSV). Each scene is one call of ``cleargs run``."""

from __future__ import annotations

import csv
import json
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, StringConstraints, ValidationError

from cleargs.base_model import FrozenModel
from cleargs.errors import InputError
from cleargs.pipeline.config import merge, parse_toml
from cleargs.pipeline.settings import flattened
from cleargs.safe_io import faults_as, read_text

NAMES = "letters, digits, and _ . - after the first, at most 100"
"""Rule for the name of a scene, for messages."""
PLAIN = ("name", "input", "recipe")
"""Columns of a CSV sheet that are not settings."""


class SheetError(InputError):
    """A sheet with mistakes. ``problems`` has one line per mistake, with its place in the sheet."""

    def __init__(self, path: Path, problems: list[str]) -> None:
        mistakes = "1 mistake" if len(problems) == 1 else f"{len(problems)} mistakes"
        super().__init__(
            f"{path.name} has {mistakes}", hint="correct the mistakes above; no scene was started"
        )
        self.problems = problems


class After(FrozenModel):
    """Work on a scene after its last stage: the table ``[after]`` of a sheet, or of one scene in it."""

    export: tuple[str, ...] = ()
    """Endings of files, and programs of ``cleargs export --for``; the files are written to BATCH/exports."""
    render: Literal["path", "turntable"] | None = None
    """The film BATCH/exports/NAME.mp4."""


class SheetRow(FrozenModel):
    """A scene of the sheet, with the sheet's defaults filled in."""

    name: Annotated[str, StringConstraints(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,99}$")]
    input: Annotated[str, StringConstraints(strip_whitespace=True, min_length=1)]
    recipe: str = "default"
    set: dict[str, str] = Field({})
    """Setting -> its value as TOML."""
    after: After = After()


@dataclass(frozen=True)
class SceneJob:
    """A scene to run."""

    name: str
    source: Path
    """Absolute path of the capture."""
    recipe: str
    """Name of a recipe, or absolute path of a TOML file."""
    overrides: tuple[str, ...]
    """Settings in the form of ``--set``."""
    where: str
    """Place in the sheet, for messages."""
    after: After = field(default_factory=After)


def read_scenes(path: Path) -> list[SceneJob]:
    """Return the scenes of a sheet: CSV if the name ends with ``.csv``, TOML otherwise.

    Settings and inputs are not checked yet. Raises SheetError with all mistakes, and InputError if the file
    cannot be read.
    """
    with faults_as(InputError, f"cannot read {path}", hint="give a sheet, TOML or CSV"):
        text = read_text(path)
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
            problems.append(f"{where}: {scenes[row.name].where} already has the name {row.name!r}")
        recipe = str(folder / row.recipe) if row.recipe.endswith(".toml") else row.recipe
        overrides = tuple(f"{name}={value}" for name, value in row.set.items())
        scenes[row.name] = SceneJob(row.name, folder / row.input, recipe, overrides, where, row.after)
    if problems:
        raise SheetError(path, problems)
    if not scenes:
        raise InputError(
            f"{path} lists no scene", hint='example: [[scene]], name = "room", input = "room.mp4"'
        )
    return list(scenes.values())


def _problem(found: Any) -> str:
    """Return one line for a mistake that pydantic found."""
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
    """Yield place and content of each ``[[scene]]`` table, with the defaults ``recipe`` and ``[set]``."""
    document = parse_toml(text, path.name)
    scenes = document.pop("scene", [])
    if not isinstance(scenes, list) or not all(isinstance(scene, dict) for scene in scenes):
        raise InputError(f"{path.name}: scene is not a list of tables", hint="write each scene as [[scene]]")
    for number, scene in enumerate(scenes, 1):
        values = merge(document, scene)
        if isinstance(given := values.get("set"), dict):  # a value in JSON is valid TOML
            values["set"] = {
                name: json.dumps(value, ensure_ascii=False, default=str) for name, value in flattened(given)
            }
        yield f"{path.name}, scene {scene.get('name', number)}", values


def _csv_rows(path: Path, text: str) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield place and content of each row. Columns outside `PLAIN` are settings; empty cells are ignored."""
    reader = csv.DictReader(text.splitlines(keepends=True), restkey="more cells than columns", strict=True)
    try:
        columns = [column.strip() for column in reader.fieldnames or ()]
        named = [column for column in columns if column]
        if not {"name", "input"} <= set(named) or len(set(named)) < len(named):
            raise InputError(
                f"{path.name}: the first line must name each column once, and include name and input",
                hint="separate the names with commas, for example name,input",
            )
        reader.fieldnames = columns
        for row in reader:
            given = {name: str(cell).strip() for name, cell in row.items() if cell and str(cell).strip()}
            if given:
                values: dict[str, Any] = {name: given.pop(name) for name in PLAIN if name in given}
                yield f"{path.name}, line {reader.line_num}", {**values, "set": given}
    except csv.Error as error:
        where = f"{path.name}, line {reader.reader.line_num}"
        raise SheetError(path, [f"{where}: this is not valid CSV: {error}"]) from error
