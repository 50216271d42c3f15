"""The scenes of a sheet, checked: every mistake is found before anything starts."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from cleargs.batch.resources import Wanted
from cleargs.batch.sheet import Problem, Row, SheetError, read_rows
from cleargs.errors import InputError, did_you_mean
from cleargs.pipeline.config import Config, Document, check_document, merge, read_recipe
from cleargs.pipeline.dag import Dag
from cleargs.pipeline.keys import settings as flat
from cleargs.untrusted import cause

NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,99}")
NAME_RULE = "letters, digits, and _ . - after the first, at most 100"
FIELDS = ("name", "input", "recipe", "set", "resources")
RESOURCES = ", ".join(Wanted.model_fields)


@dataclass(frozen=True)
class Scene:
    """One scene to bring through the stages."""

    name: str
    source: Path
    """Absolute."""
    config: Config
    wanted: Mapping[str, Wanted]
    """Stage -> what the sheet says of its resources."""
    line: int
    """Where in the sheet."""


def read_scenes(path: Path, dag: Dag) -> list[Scene]:
    """The scenes of the sheet ``path``. Raises SheetError with all mistakes, InputError for no sheet."""
    rows, problems = read_rows(path)
    checker = _Checker(path.absolute().parent, dag, problems)
    scenes = [scene for row in rows if (scene := checker.scene(row)) is not None]
    if checker.problems:
        raise SheetError(path, sorted(checker.problems))
    return scenes


class _Checker:
    """Collects what is wrong with the rows of one sheet."""

    def __init__(self, folder: Path, dag: Dag, problems: Iterable[Problem]) -> None:
        self.folder = folder
        self.dag = dag
        self.problems = set(problems)
        self._names: dict[str, int] = {}
        self._recipe = cache(self._read_recipe)

    def scene(self, row: Row) -> Scene | None:
        """The scene of ``row``; None where something is wrong with it, which is then among the problems."""
        before = len(self.problems)
        for name in row.values.keys() - set(FIELDS):
            hint = did_you_mean(name, FIELDS, f"known: {', '.join(FIELDS)}")
            self._note(row.line_of(name), f"a scene has no field {name!r}; {hint}")
        name = self._name(row)
        source = self._source(row)
        config = self._config(row)
        wanted = self._wanted(row)
        if config is None or len(self.problems) > before:
            return None
        return Scene(name, source, config, wanted, row.line)

    def _note(self, line: int, text: str) -> None:
        self.problems.add(Problem(line, text))

    def _name(self, row: Row) -> str:
        name, line = row.values.get("name"), row.line_of("name")
        if not isinstance(name, str):
            self._note(row.line, "the scene has no name")
            return ""
        if not NAME.fullmatch(name):
            self._note(line, f"the name {name!r} may hold {NAME_RULE}")
        elif name in self._names:
            self._note(line, f"the name {name!r} is taken on line {self._names[name]}")
        self._names.setdefault(name, line)
        return name

    def _source(self, row: Row) -> Path:
        """The input, relative to the folder of the sheet."""
        given = row.values.get("input")
        if not isinstance(given, str) or not given.strip():
            self._note(row.line_of("input"), "the scene has no input")
            return self.folder
        source = self.folder / given
        try:
            there = source.exists()
        except OSError as error:  # a name that is too long
            self._note(row.line_of("input"), f"{source} cannot be read: {cause(error)}")
            return source
        if not there:
            self._note(row.line_of("input"), f"there is no {source}")
        return source

    def _config(self, row: Row) -> Config | None:
        """The recipe and the scene's settings. Each setting is tried alone, so that each mistake is named."""
        recipe = row.values.get("recipe", "default")
        settings = row.values.get("set", {})
        if not isinstance(recipe, str) or not isinstance(settings, dict):
            self._note(row.line, "recipe is a text, set is a table of settings")
            return None
        document = self._recipe(recipe)
        if isinstance(document, InputError):
            self._note(row.line_of("recipe"), _said(document))
            return None
        wrong = False
        for name, value in flat(settings):
            try:
                check_document(self.dag, merge(document, _nested(name, value)))
            except InputError as error:
                self._note(row.line_of(f"set.{name}"), _said(error))
                wrong = True
        if wrong:
            return None
        whole = document
        for name, value in flat(settings):
            whole = merge(whole, _nested(name, value))
        try:
            return check_document(self.dag, whole)
        except InputError as error:
            self._note(row.line_of("set"), _said(error))
            return None

    def _read_recipe(self, recipe: str) -> Document | InputError:
        """The document of a recipe, checked; the error where there is none that can be used."""
        place = str(self.folder / recipe) if recipe.endswith(".toml") else recipe
        try:
            document = read_recipe(place)
            check_document(self.dag, document)
            return document
        except InputError as error:
            return error

    def _wanted(self, row: Row) -> dict[str, Wanted]:
        tables = row.values.get("resources", {})
        wanted = {name: Wanted() for name in self.dag.names}
        if not isinstance(tables, dict):
            self._note(row.line_of("resources"), "resources is a table of stages")
            return wanted
        for name, table in tables.items():
            if name not in wanted:
                self._note(row.line_of(f"resources.{name}"), f"resources: there is no stage {name!r}")
                continue
            if not isinstance(table, dict):
                self._note(row.line_of(f"resources.{name}"), f"resources.{name} is a table of {RESOURCES}")
                continue
            try:
                wanted[name] = Wanted.model_validate(table)
            except ValidationError as error:
                for found in error.errors(include_url=False):
                    field = ".".join(["resources", name, *(str(part) for part in found["loc"])])
                    self._note(row.line_of(field), f"{field}: {found['msg']}")
        return wanted


def _said(error: InputError) -> str:
    return f"{error}; {error.hint}"


def _nested(name: str, value: Any) -> Document:
    """The document in which the dotted ``name`` alone is set; a quoted "g0.steps" counts as two parts."""
    document: Any = value
    for part in reversed(name.split(".")):
        document = {part: document}
    return dict(document)
