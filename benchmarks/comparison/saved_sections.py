"""What was found in a section of the evidence, as a file beside the page.

Sections that were made at different times, or on different machines, come together on one page.
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
    """``results/NAME.json``: all that the tables of a section are made from."""

    section: Section
    version: str
    """Of the source that made it."""
    machine: str
    missing: tuple[str, ...]
    """What could not be made, and why, a line each."""
    cells: tuple[Cell, ...]
    """Empty where nothing of the section could be made."""
    roles: tuple[Roles, ...]
    choices: tuple[Choices, ...]

    @property
    def results(self) -> Results:
        return Results(Cells(self.cells), self.roles, self.choices)


def save_section(folder: Path, found: SectionOutcome, version: str, machine: str) -> None:
    """Write what was found in a section to ``folder``, in place of what an earlier call found there."""
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
    """Those of ``sections`` that ``folder`` has, as they are listed now; what was made from another list, or
    cannot be read, is left out with a warning.
    """
    found = []
    for section in sections:
        path = _file(folder, section)
        if not path.exists():
            continue
        try:
            kept = SavedSection.model_validate_json(read_bytes(path))
        except (OSError, ValidationError):
            reporter.warn(f"{path} cannot be read: the page leaves {section.title!r} out")
            continue
        if kept.section == section:
            found.append(kept)
        else:
            reporter.warn(f"{path} is of another list: the page leaves {section.title!r} out")
    return found


def _file(folder: Path, section: Section) -> Path:
    return folder / f"{section.name}.json"
