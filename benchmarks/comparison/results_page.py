"""The page of results: a template of words, and tables of what `python -m benchmarks evidence` found."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from benchmarks.comparison.cells import Cells, ViewSet
from benchmarks.comparison.evidence import Section
from benchmarks.comparison.gaps import VERDICTS, Gap, compared_with, is_behind, losses_table
from benchmarks.comparison.saved_sections import SavedSection
from benchmarks.comparison.tables import (
    COMPARED,
    NAMES,
    TITLES,
    Table,
    choices_table,
    counted,
    difference_text,
    metric_title,
    roles_table,
    value_texts,
    work_table,
)
from benchmarks.comparison.variants import QUESTIONS, VARIANTS, WHOLE

CONFIDENCE = "95 %"
"""Of all intervals (`benchmarks.comparison.cells.student_t`)."""

_ROUGH = "This is the rough page (`--quick`): small images, short trainings, few captures."


@dataclass(frozen=True)
class Origin:
    """How a page is made."""

    command: str
    """Without the names of sections."""
    recipe: str
    quick: bool
    sections: tuple[Section, ...]
    """All that its list has."""


def made(origin: Origin, found: Sequence[SavedSection]) -> str:
    """The line under a table: the command that makes these sections, and the versions that made them."""
    names = [] if len(found) == len(origin.sections) else [kept.section.name for kept in found]
    command = " ".join((origin.command, *(f"--section {name}" for name in names)))
    return f"`{command}`, version {_all(kept.version for kept in found)}"


def results_page(found: Sequence[SavedSection], origin: Origin) -> str:
    """The whole page as Markdown; pictures are expected in ``results/`` beside it, by the sections' names."""
    template = Path(__file__).with_name("results.md").read_text(encoding="utf-8")
    nets = {metric for kept in found for metric in kept.results.cells.metrics()}
    lacking = [NAMES[name] for name in ("lpips_alex", "lpips_vgg") if name not in nets]
    warnings = [_ROUGH] * origin.quick
    there = {kept.section.name for kept in found}
    if absent := [section.title for section in origin.sections if section.name not in there]:
        warnings.append(f"Not made yet: {', '.join(absent)}.")
    if lacking:
        warnings.append(f"{' and '.join(lacking)} could not be measured: `cleargs models install lpips`.")
    values = {
        "warning": "\n".join(f"**{warning}**" for warning in warnings),
        "confidence": CONFIDENCE,
        "losses": losses_found(found),
        "answers": answers_table(found),
        "recipe": origin.recipe,
        "variants": "\n".join(_variant_rows()),
        "made": made(origin, found),
        "machine": _all(kept.machine for kept in found),
        "sections": "\n\n".join(_section(kept, origin) for kept in found),
    }
    return re.sub(r"@(\w+)@", lambda match: values[match[1]], template).rstrip() + "\n"


def gaps(kept: Sequence[SavedSection]) -> list[tuple[str, Gap]]:
    """Sections, and the whole method against every other variant in each of their cells."""
    once = _Once()
    return [
        (one.section.title, gap)
        for one in _as_they_are(kept)
        for cells in (one.results.cells,)
        for gap in compared_with(cells, WHOLE)
        if once.is_new(cells, gap.views, gap.column, WHOLE, gap.against, gap.metric)
    ]


def _as_they_are(kept: Sequence[SavedSection]) -> list[SavedSection]:
    """The sections whose images were judged as they are: they hold all scenes."""
    return [one for one in kept if not one.section.align_colour]


def losses(kept: Sequence[SavedSection]) -> list[tuple[str, Gap]]:
    """Those in which the whole method is behind, the sure ones first."""
    found = [(section, gap) for section, gap in gaps(kept) if is_behind(gap.difference, gap.metric)]
    return sorted(found, key=lambda item: VERDICTS.index(item[1].verdict))


def losses_found(kept: Sequence[SavedSection]) -> str:
    """The losses, and of how many comparisons they are."""
    found, labels = losses(kept), _labels()
    compared = len(gaps(kept))
    sure = sum(loss.verdict == "sure" for _, loss in found)
    line = f"{len(found)} of {compared} comparisons, {sure} of them sure."
    places = [
        ((section, loss.column, TITLES[loss.views].split(",")[0], labels[loss.against]), loss)
        for section, loss in found
    ]
    rows = losses_table(("section", "column", "views", "behind"), places)
    return f"{line}\n\n{rows.markdown()}" if found else line


def answers_table(kept: Sequence[SavedSection]) -> str:
    """For each question and metric, in how many columns the answer is better, worse or none."""
    rows, once = [], _Once()
    for question, variant, against in QUESTIONS:
        row = [question]
        for metric in COMPARED:
            found = [
                difference
                for cells in (one.results.cells for one in _as_they_are(kept))
                for views in cells.view_sets()
                for column in cells.columns(views)
                if (difference := cells.difference(views, column, variant, against, metric)) is not None
                and once.is_new(cells, views, column, variant, against, metric)
            ]
            worse = sum(one.is_sure and is_behind(one, metric) for one in found)
            better = sum(one.is_sure for one in found) - worse
            row.append(f"{better} / {worse} / {len(found) - better - worse}" if found else "not made")
        rows.append(row)
    return Table(["better / worse / none", *(NAMES[metric] for metric in COMPARED)], rows).markdown()


def questions_table(cells: Cells, views: ViewSet) -> str:
    """The differences that answer the questions, a row a question and metric; empty without any."""
    columns = cells.columns(views)
    rows = []
    for question, variant, against in QUESTIONS:
        for metric in COMPARED:
            found = [cells.difference(views, column, variant, against, metric) for column in columns]
            if any(found):
                bases = [cells.spread(views, column, against, metric) for column in columns]
                texts = [difference_text(*pair, metric) for pair in zip(found, bases, strict=True)]
                rows.append([question, NAMES[metric], *texts])
    return Table(["", "", *counted(cells, views)], rows).markdown() if rows else ""


def values_table(cells: Cells, views: ViewSet) -> str:
    """Means of all variants, a row a metric and variant; the best of a column and metric in bold."""
    labels, columns, rows = _labels(), cells.columns(views), []
    for metric in cells.metrics():
        for variant in cells.variants():
            texts = value_texts(cells, views, variant, metric)
            rows.append([metric_title(metric), labels[variant], *texts])
    return Table(["", "", *columns], rows).markdown()


class _Once:
    """Tells what another section has compared already: sections share scenes, and none may count twice."""

    def __init__(self) -> None:
        self._known: dict[tuple[str, str, str], list[frozenset[tuple[str, str]]]] = {}

    def is_new(
        self, cells: Cells, views: ViewSet, column: str, variant: str, against: str, metric: str
    ) -> bool:
        """Whether no earlier call had all of these pairs of judged scenes, perhaps among others."""
        theirs = {cell.sample: cell.evaluation for cell in cells.of(views, column, against)}
        ours = cells.of(views, column, variant)
        pairs = frozenset((cell.evaluation, theirs[cell.sample]) for cell in ours if cell.sample in theirs)
        known = self._known.setdefault((variant, against, metric), [])
        if any(pairs <= other for other in known):
            return False
        known.append(pairs)
        return True


def _all(words: Iterable[str]) -> str:
    """Each of them once."""
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


def _section(kept: SavedSection, origin: Origin) -> str:
    """Tables and pictures of a section, and what of it is missing."""
    section, line = kept.section, made(origin, [kept])
    parts = [f"## {section.title}", _setting(section)]
    if kept.missing:
        parts.append("Not made:\n\n" + "\n".join(f"* {reason}" for reason in kept.missing))
    if not kept.cells:
        return "\n\n".join([*parts, f"Nothing of this section could be made ({line})."])
    results, labels = kept.results, _labels()
    cells = results.cells
    for views in cells.view_sets():
        parts += [f"### {TITLES[views]}", values_table(cells, views), line]
        if questions := questions_table(cells, views):
            parts += ["Differences:", questions, line]
    parts += ["### Work", work_table(cells, labels).markdown(), line]
    parts += ["### Roles of the frames", roles_table(results.roles, labels).markdown(), line]
    if results.choices:
        parts += ["### The choice against the truth", choices_table(results.choices, labels).markdown(), line]
    elif section.kind == "video":
        parts.append("Whether RIVR chose well cannot be said here: the repaired frames have no truth.")
    parts += [
        f"![Differences, {section.title}](results/{section.name}.png)",
        f"![Truth, input and scenes, {section.title}](results/{section.name}-sheet.jpg)",
        line,
    ]
    return "\n\n".join(parts)


def _setting(section: Section) -> str:
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
        parts.append("each image judged after the affine on sRGB that fits it to the truth best")
    return "; ".join(parts) + "."
