"""Pages behind the front page of the results, with tables from `python -m benchmarks evidence`.

One page has the summary (the template ``results.md``), and each section has its own.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from benchmarks.comparison.cells import Cells, ViewSet
from benchmarks.comparison.evidence import Section
from benchmarks.comparison.front_page import FAULTS
from benchmarks.comparison.gaps import SIGNIFICANCE, Gap, compared_with, is_worse, losses_table
from benchmarks.comparison.saved_sections import SavedSection
from benchmarks.comparison.tables import (
    COMPARED,
    NAMES,
    TITLES,
    Table,
    choices_table,
    columns_with_counts,
    difference_text,
    metric_title,
    roles_table,
    value_texts,
    work_table,
)
from benchmarks.comparison.variants import QUESTIONS, VARIANTS, WHOLE

CONFIDENCE = "95 %"
"""Confidence of all intervals (`benchmarks.comparison.cells.student_t`)."""

_MADE = "<!-- Made by `python -m benchmarks evidence`; edits are lost. -->"
_OLDER = "This section was made from another list of captures than the present one."
_QUICK = "This is the quick page (`--quick`): small images, short trainings, few captures."


@dataclass(frozen=True)
class Origin:
    """Command and list of sections from which a page is made."""

    command: str
    """The command, without its options ``--section``."""
    recipe: str
    quick: bool
    sections: tuple[Section, ...]
    """All sections of the list."""


def provenance(origin: Origin, found: Sequence[SavedSection]) -> str:
    """Return the line under a table: the command for these sections and the versions that made them."""
    names = [] if len(found) == len(origin.sections) else [saved.section.name for saved in found]
    command = " ".join((origin.command, *(f"--section {name}" for name in names)))
    return f"`{command}`, version {_join_unique(saved.version for saved in found)}"


def summary_page(found: Sequence[SavedSection], origin: Origin) -> str:
    """Return the page with losses, answers and methods as Markdown; it links to the pages of the sections."""
    template = Path(__file__).with_name("results.md").read_text(encoding="utf-8")
    nets = {metric for saved in found for metric in saved.results.cells.metrics()}
    missing = [NAMES[name] for name in ("lpips_alex", "lpips_vgg") if name not in nets]
    warnings = [_QUICK] * origin.quick
    present = {saved.section.name for saved in found}
    if absent := [section.title for section in origin.sections if section.name not in present]:
        warnings.append(f"Not made yet: {', '.join(absent)}.")
    if missing:
        warnings.append(f"{' and '.join(missing)} could not be measured (`cleargs models install lpips`).")
    values = {
        "warning": "\n".join(f"**{warning}**" for warning in warnings),
        "confidence": CONFIDENCE,
        "losses": losses_found(found),
        "answers": answers_table(found),
        "recipe": origin.recipe,
        "variants": "\n".join(_variant_rows()),
        "faults": Table(
            ["name", "fault (px: mean length at a width of 640 px)"],
            [[f"`{name}`", words] for name, words in FAULTS.items()],
        ).markdown(),
        "made": provenance(origin, found),
        "machine": _join_unique(saved.machine for saved in found),
        "sections": _contents(found, origin),
    }
    return re.sub(r"@(\w+)@", lambda match: values[match[1]], template).rstrip() + "\n"


def section_page(saved: SavedSection, origin: Origin) -> str:
    """Return the page of a section as Markdown: pictures, tables, and reasons for missing results."""
    section, line = saved.section, provenance(origin, [saved])
    parts = [
        f"# {section.title}",
        _MADE,
        f"{_conditions(section)} Made by version {saved.version}. [All sections](all.md) explains the names.",
    ]
    if section not in origin.sections:
        parts.append(_OLDER)
    if saved.missing:
        parts.append("Not made:\n\n" + "\n".join(f"* {reason}" for reason in saved.missing))
    if not saved.cells:
        return "\n\n".join([*parts, f"No result of this section could be made ({line})."]) + "\n"
    results, labels = saved.results, _labels()
    cells = results.cells
    parts.append(f"![Differences, {section.title}]({section.name}.png)")
    if section.kind == "rooms":
        parts.append(f"![Truth, input and scenes, {section.title}]({section.name}-sheet.jpg)")
    for views in cells.view_sets():
        parts += [f"## {TITLES[views]}", values_table(cells, views)]
        if questions := questions_table(cells, views):
            parts += ["Differences:", questions]
    parts += ["## Work", work_table(cells, labels).markdown()]
    parts += ["## Roles of the frames", roles_table(results.roles, labels).markdown()]
    if results.choices:
        parts += ["## Choices of RIVR against the truth", choices_table(results.choices, labels).markdown()]
    elif section.kind == "video":
        parts.append("The choices of RIVR cannot be evaluated here: the repaired frames have no truth.")
    return "\n\n".join([*parts, line]) + "\n"


def _contents(found: Sequence[SavedSection], origin: Origin) -> str:
    """Return a table with a link to each section, its columns and its version."""
    rows = [
        [
            f"[{saved.section.title}]({saved.section.name}.md)",
            ", ".join(dict.fromkeys(cell.column for cell in saved.cells)),
            str(saved.section.steps),
            saved.version + (" (another list)" if saved.section not in origin.sections else ""),
        ]
        for saved in found
    ]
    return Table(["section", "captures", "steps", "version"], rows).markdown()


def gaps(saved: Sequence[SavedSection]) -> list[tuple[str, Gap]]:
    """Return (section title, comparison of the whole method with another variant) for all cells."""
    once = _SeenComparisons()
    return [
        (one.section.title, gap)
        for one in _without_alignment(saved)
        for cells in (one.results.cells,)
        for gap in compared_with(cells, WHOLE)
        if once.is_new(cells, gap.views, gap.column, WHOLE, gap.against, gap.metric)
    ]


def _without_alignment(saved: Sequence[SavedSection]) -> list[SavedSection]:
    """Return the sections without colour alignment; they contain all scenes."""
    return [one for one in saved if not one.section.align_colour]


def losses(saved: Sequence[SavedSection]) -> list[tuple[str, Gap]]:
    """Return the comparisons in which the whole method is worse, significant differences first."""
    found = [(section, gap) for section, gap in gaps(saved) if is_worse(gap.difference, gap.metric)]
    return sorted(found, key=lambda item: SIGNIFICANCE.index(item[1].significance))


def losses_found(saved: Sequence[SavedSection]) -> str:
    """Return the table of losses and a line with their number."""
    found, labels = losses(saved), _labels()
    compared = len(gaps(saved))
    significant = sum(loss.significance == "significant" for _, loss in found)
    line = f"Worse in {len(found)} of {compared} comparisons, significantly in {significant} of them."
    places = [
        ((section, loss.column, TITLES[loss.views].split(",")[0], labels[loss.against]), loss)
        for section, loss in found
    ]
    rows = losses_table(("section", "column", "views", "worse than"), places)
    return f"{line}\n\n{rows.markdown()}" if found else line


def answers_table(saved: Sequence[SavedSection]) -> str:
    """Return a table with the number of better, worse and other columns per question and metric."""
    rows, once = [], _SeenComparisons()
    for question, variant, against in QUESTIONS:
        row = [question]
        for metric in COMPARED:
            found = [
                difference
                for cells in (one.results.cells for one in _without_alignment(saved))
                for views in cells.view_sets()
                for column in cells.columns(views)
                if (difference := cells.difference(views, column, variant, against, metric)) is not None
                and once.is_new(cells, views, column, variant, against, metric)
            ]
            worse = sum(one.excludes_zero and is_worse(one, metric) for one in found)
            better = sum(one.excludes_zero for one in found) - worse
            row.append(f"{better} / {worse} / {len(found) - better - worse}" if found else "not made")
        rows.append(row)
    return Table(["better / worse / none", *(NAMES[metric] for metric in COMPARED)], rows).markdown()


def questions_table(cells: Cells, views: ViewSet) -> str:
    """Return a table of differences with one row per question and metric; "" without differences."""
    columns = cells.columns(views)
    rows = []
    for question, variant, against in QUESTIONS:
        for metric in COMPARED:
            found = [cells.difference(views, column, variant, against, metric) for column in columns]
            if any(found):
                bases = [cells.spread(views, column, against, metric) for column in columns]
                texts = [difference_text(*pair, metric) for pair in zip(found, bases, strict=True)]
                rows.append([question, NAMES[metric], *texts])
    return Table(["", "", *columns_with_counts(cells, views)], rows).markdown() if rows else ""


def values_table(cells: Cells, views: ViewSet) -> str:
    """Return a table of means with one row per metric and variant; the best of a column is bold."""
    labels, columns, rows = _labels(), cells.columns(views), []
    for metric in cells.metrics():
        for variant in cells.variants():
            texts = value_texts(cells, views, variant, metric)
            rows.append([metric_title(metric), labels[variant], *texts])
    return Table(["", "", *columns], rows).markdown()


class _SeenComparisons:
    """Comparisons seen so far: sections share scenes, and no comparison may count twice."""

    def __init__(self) -> None:
        self._known: dict[tuple[str, str, str], list[frozenset[tuple[str, str]]]] = {}

    def is_new(
        self, cells: Cells, views: ViewSet, column: str, variant: str, against: str, metric: str
    ) -> bool:
        """Return True if no earlier call included all these pairs of evaluated scenes; remember them."""
        theirs = {cell.sample: cell.evaluation for cell in cells.of(views, column, against)}
        ours = cells.of(views, column, variant)
        pairs = frozenset((cell.evaluation, theirs[cell.sample]) for cell in ours if cell.sample in theirs)
        known = self._known.setdefault((variant, against, metric), [])
        if any(pairs <= other for other in known):
            return False
        known.append(pairs)
        return True


def _join_unique(words: Iterable[str]) -> str:
    """Join ``words`` by "and", each once."""
    return " and ".join(dict.fromkeys(words))


def _labels() -> dict[str, str]:
    return {variant.name: variant.label for variant in VARIANTS}


def _variant_rows() -> list[str]:
    rows = []
    for variant in VARIANTS:
        recipe = f"recipe `{variant.workflow}`" if variant.workflow else ""
        changes = [recipe] * bool(recipe) + [f"`{line}`" for line in variant.overrides]
        scene = f"the scene of `{variant.stage}`"
        rows.append(f"| {variant.label} | {', '.join(changes) or 'nothing'}; {scene} |")
    return rows


def _conditions(section: Section) -> str:
    width, height = section.size
    size = f"long side at most {max(section.size)} px" if section.kind == "video" else f"{width}x{height}"
    steps = ", ".join(str(section.steps * factor) for factor in section.factors)
    parts = [
        f"{section.frames} frames, {size}",
        f"seeds {', '.join(map(str, section.seeds))}",
        f"{steps} steps",
    ]
    if section.settings:
        parts.append(f"settings {', '.join(f'`{line}`' for line in section.settings)}")
    if section.align_colour:
        parts.append("colours of each image fitted to the truth (affine in sRGB) before measuring")
    return "; ".join(parts) + "."
