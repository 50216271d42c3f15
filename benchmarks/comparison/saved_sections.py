"""Results of each section of the evidence as a file next to the page.

So one page can show sections that were made at different times or on different machines.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from pydantic import ValidationError

from benchmarks.comparison.cells import Cell, Cells
from benchmarks.comparison.choices import Choices
from benchmarks.comparison.evidence import Section, SectionOutcome
from benchmarks.comparison.roles import Roles
from benchmarks.comparison.tables import Results
from cleargs.evaluate.eval_report import Figures
from cleargs.files import write_bytes
from cleargs.progress import Reporter
from cleargs.safe_io import read_bytes


class SavedSection(Figures):
    """``results/NAME.json``: the data behind the tables of a section."""

    section: Section
    version: str
    """Version of the source that made it."""
    machine: str
    missing: tuple[str, ...]
    """Names of missing captures and scenes with the reason, one per line."""
    cells: tuple[Cell, ...]
    """Empty if no scene of the section could be made."""
    roles: tuple[Roles, ...]
    choices: tuple[Choices, ...]

    @property
    def results(self) -> Results:
        return Results(Cells(self.cells), self.roles, self.choices)


def save_section(folder: Path, found: SectionOutcome, version: str, machine: str) -> None:
    """Write the results of a section to ``folder``; they replace those of an earlier call."""
    compared = found.compared
    kept = SavedSection(
        section=found.section,
        version=version,
        machine=machine,
        missing=found.missing,
        cells=tuple(compared.cells if compared else ()),
        roles=tuple(compared.roles if compared else ()),
        choices=tuple(compared.choices if compared else ()),
    )
    folder.mkdir(parents=True, exist_ok=True)
    write_bytes(_file(folder, found.section), kept.model_dump_json().encode())


def read_sections(folder: Path, sections: Iterable[Section], reporter: Reporter) -> list[SavedSection]:
    """Read the results of ``sections`` from ``folder``.

    Unreadable files are left out with a warning. A file from another list of evidence is read, with a
    warning: its figures are valid for the captures and settings that are stored in it.
    """
    found = []
    for section in sections:
        path = _file(folder, section)
        if not path.exists():
            continue
        try:
            kept = SavedSection.model_validate_json(read_bytes(path))
        except (OSError, ValidationError):
            reporter.warn(f"cannot read {path}: the pages do not include {section.title!r}")
            continue
        if kept.section != section:
            reporter.warn(f"{path} was made from another list of evidence")
        found.append(kept)
    return found


def _file(folder: Path, section: Section) -> Path:
    return folder / f"{section.name}.json"
