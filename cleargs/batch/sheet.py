"""A sheet of scenes as it lies in a TOML or CSV file, with the line of everything in it."""

from __future__ import annotations

import csv
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from cleargs.errors import ConfigError, InputError
from cleargs.pipeline.config import merge, parse_override, parse_toml
from cleargs.untrusted import FAULTS, cause, read_text

SCENE_HEADER = re.compile(r"\s*\[\[\s*scene\s*\]\]")
ASSIGNMENT = re.compile(r"\s*([^=#\[\]]+?)\s*=")
TABLE = re.compile(r"\s*\[([^\[\]]+)\]")
PLAIN = ("name", "input", "recipe")
"""Columns of a CSV sheet that are taken as they are."""
NEEDED = ("name", "input")
FIRST_LINE = "the first line names the columns, with commas between them"


@dataclass(frozen=True, order=True)
class Problem:
    """One thing that is wrong with a sheet."""

    line: int
    text: str


class SheetError(InputError):
    """A sheet with mistakes: all of them, each with its line."""

    def __init__(self, path: Path, problems: list[Problem]) -> None:
        count = len(problems)
        super().__init__(
            f"{path.name} has {count} mistake{'s' if count > 1 else ''}",
            hint="correct the lines named above; nothing was started",
        )
        self.path = path
        self.problems = sorted(problems)


@dataclass(frozen=True)
class Row:
    """One scene of a sheet, the sheet's own defaults filled in, nothing checked yet."""

    line: int
    values: Mapping[str, Any]
    """``name``, ``input``, ``recipe``, ``set`` (settings) and ``resources``, as far as they are given."""
    lines: Mapping[str, int] = field(default_factory=dict)
    """Dotted name (``set.g0.steps``) -> the line where it is given."""

    def line_of(self, name: str) -> int:
        """The line of ``name`` (dotted), or of the nearest table around it; else that of the scene."""
        while name and name not in self.lines:
            name = name.rpartition(".")[0]
        return self.lines.get(name, self.line)


def read_rows(path: Path) -> tuple[list[Row], list[Problem]]:
    """The scenes that the sheet ``path`` lists, and what is wrong with single cells: CSV where its name ends
    so, TOML otherwise.

    Raises InputError when the file cannot be read or is no such file, SheetError where nothing can be made of
    a CSV.
    """
    try:
        text = read_text(path)
    except FAULTS as error:
        raise InputError(f"cannot read {path}: {cause(error)}", hint="give a sheet, TOML or CSV") from error
    is_csv = path.suffix.lower() == ".csv"
    rows, problems = _csv_rows(path, text) if is_csv else (_toml_rows(path, text), [])
    if not rows and not problems:
        raise InputError(f"{path} lists no scene", hint='write [[scene]], name = "room", input = "room.mp4"')
    return rows, problems


# -- TOML --------------------------------------------------------------------------------------------------


def _toml_rows(path: Path, text: str) -> list[Row]:
    """``[[scene]]`` tables; ``recipe``, ``[set]`` and ``[resources]`` above them hold for all scenes."""
    document = parse_toml(text, path.name)
    scenes = document.pop("scene", [])
    if not isinstance(scenes, list) or not all(isinstance(scene, dict) for scene in scenes):
        raise InputError(f"{path.name}: scene is no list of tables", hint="write each scene as [[scene]]")
    head, blocks = _blocks(text)
    common = _assignments(head)
    return [
        Row(block[0][0] if block else 1, merge(document, scene), {**common, **_assignments(block)})
        for scene, block in zip(scenes, blocks + [[]] * (len(scenes) - len(blocks)), strict=False)
    ]


Block = list[tuple[int, str]]
"""Numbered lines."""


def _blocks(text: str) -> tuple[Block, list[Block]]:
    """The numbered lines above the first ``[[scene]]``, and those of each scene."""
    head: Block = []
    blocks: list[Block] = []
    for number, line in enumerate(text.splitlines(), 1):
        if SCENE_HEADER.match(line):
            blocks.append([])
        (blocks[-1] if blocks else head).append((number, line))
    return head, blocks


def _assignments(block: Block) -> dict[str, int]:
    """Dotted name of each table and each value in ``block``, as seen from the scene -> its line."""
    lines: dict[str, int] = {}
    table = ""
    for number, line in block:
        if header := TABLE.match(line):
            table = _plain(header[1]).removeprefix("scene.") + "."
            lines[table.rstrip(".")] = number
        elif found := ASSIGNMENT.match(line):
            lines[table + _plain(found[1])] = number
    return lines


def _plain(name: str) -> str:
    """A dotted name without quotes and spaces."""
    return re.sub(r"[\s\"']", "", name)


# -- CSV ---------------------------------------------------------------------------------------------------


def _csv_rows(path: Path, text: str) -> tuple[list[Row], list[Problem]]:
    """Columns ``name``, ``input``, ``recipe``; any other is a setting (``g0.steps``) or a resource
    (``resources.g0.minutes``). An empty cell says nothing."""
    (_, header), *rows = _table(path, text)
    missing = [name for name in NEEDED if name not in header]
    if missing:
        raise SheetError(path, [Problem(1, f"there is no column {name}; {FIRST_LINE}") for name in missing])
    problems = [Problem(1, f"column {name!r} is given twice") for name in _repeated(header)]
    found = []
    for line, cells in rows:
        if len(cells) > len(header):
            problems.append(Problem(line, f"{len(cells)} cells, but the header names {len(header)}"))
        values: dict[str, Any] = {}
        for column, cell in zip(header, cells, strict=False):
            if cell:
                try:
                    values = merge(values, _cell(column, cell))
                except ConfigError:
                    text = f"{cell!r} stands below {column!r}, which names no setting"
                    problems.append(Problem(line, text))
        if any(cells):
            found.append(Row(line, values))
    return found, problems


def _table(path: Path, text: str) -> list[tuple[int, list[str]]]:
    """All rows, numbered, the header first."""
    reader = csv.reader(text.splitlines(keepends=True), strict=True)
    try:
        table = [(reader.line_num, [cell.strip() for cell in cells]) for cells in reader]
    except csv.Error as error:
        raise SheetError(path, [Problem(reader.line_num, f"no CSV: {error}")]) from error
    return table or [(1, [])]


def _cell(column: str, cell: str) -> dict[str, Any]:
    if column in PLAIN:
        return {column: cell}
    document = parse_override(f"{column}={cell}")
    return document if column.startswith("resources.") else {"set": document}


def _repeated(names: list[str]) -> Iterator[str]:
    yield from sorted({name for name in names if name and names.count(name) > 1})
