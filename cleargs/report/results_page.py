"""The page of results: a template of words, and tables of what `cleargs evidence` found."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.resources import files

from cleargs.evaluate.cells import Cells, ViewSet
from cleargs.evaluate.comparison_tables import (
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
from cleargs.evaluate.evidence import Outcome, Section
from cleargs.evaluate.gaps import VERDICTS, Gap, compared_with, is_behind, losses_table
from cleargs.evaluate.variants import QUESTIONS, VARIANTS, WHOLE

CONFIDENCE = "95 %"
"""Of all intervals (`cleargs.evaluate.cells.student_t`)."""

_ROUGH = "This is the rough page (`--quick`): small images, short trainings, few captures."


@dataclass(frozen=True)
class Origin:
    """How a page was made."""

    version: str
    command: str
    """Without the names of sections."""
    sections: tuple[str, ...]
    """Those that were asked for; empty for all."""
    recipe: str
    quick: bool
    threads: int
    device: str

    def made(self, section: Section | None = None) -> str:
        """The line under a table."""
        names = self.sections if section is None else (section.name,)
        command = " ".join((self.command, *(f"--section {name}" for name in names)))
        return f"`{command}`, version {self.version}"


def results_page(outcomes: Sequence[Outcome], origin: Origin) -> str:
    """The whole page as Markdown; pictures are expected in ``results/`` beside it, by the sections' names."""
    template = (files("cleargs.report") / "results.md").read_text(encoding="utf-8")
    nets = {
        metric for found in outcomes if found.compared for metric in found.compared.results.cells.metrics()
    }
    lacking = [NAMES[name] for name in ("lpips_alex", "lpips_vgg") if name not in nets]
    warnings = [_ROUGH] * origin.quick
    if lacking:
        warnings.append(f"{' and '.join(lacking)} could not be measured: `cleargs models install lpips`.")
    values = {
        "warning": "\n".join(f"**{warning}**" for warning in warnings),
        "confidence": CONFIDENCE,
        "losses": losses_found(outcomes),
        "answers": answers_table(outcomes),
        "recipe": origin.recipe,
        "variants": "\n".join(_variant_rows()),
        "made": origin.made(),
        "machine": f"{origin.device}, {origin.threads} threads",
        "sections": "\n\n".join(_section(found, origin) for found in outcomes),
    }
    return re.sub(r"@(\w+)@", lambda match: values[match[1]], template).rstrip() + "\n"


def gaps(outcomes: Sequence[Outcome]) -> list[tuple[str, Gap]]:
    """Sections, and the whole method against every other variant in each of their cells."""
    once = _Once()
    return [
        (outcome.section.title, gap)
        for outcome, cells in _compared(outcomes)
        for gap in compared_with(cells, WHOLE)
        if once.is_new(cells, gap.views, gap.column, WHOLE, gap.against, gap.metric)
    ]


def losses(outcomes: Sequence[Outcome]) -> list[tuple[str, Gap]]:
    """Those in which the whole method is behind, the sure ones first."""
    found = [(section, gap) for section, gap in gaps(outcomes) if is_behind(gap.difference, gap.metric)]
    return sorted(found, key=lambda item: VERDICTS.index(item[1].verdict))


def losses_found(outcomes: Sequence[Outcome]) -> str:
    """The losses, and of how many comparisons they are."""
    found, labels = losses(outcomes), _labels()
    compared = len(gaps(outcomes))
    sure = sum(loss.verdict == "sure" for _, loss in found)
    line = f"{len(found)} of {compared} comparisons, {sure} of them sure."
    places = [
        ((section, loss.column, TITLES[loss.views].split(",")[0], labels[loss.against]), loss)
        for section, loss in found
    ]
    rows = losses_table(("section", "column", "views", "behind"), places)
    return f"{line}\n\n{rows.markdown()}" if found else line


def answers_table(outcomes: Sequence[Outcome]) -> str:
    """For each question and metric, in how many columns the answer is better, worse or none."""
    rows, once = [], _Once()
    for question, variant, against in QUESTIONS:
        row = [question]
        for metric in COMPARED:
            found = [
                difference
                for _, cells in _compared(outcomes)
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


def _compared(outcomes: Sequence[Outcome]) -> list[tuple[Outcome, Cells]]:
    """The sections that could be made, with their cells."""
    return [(found, found.compared.results.cells) for found in outcomes if found.compared is not None]


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


def _section(found: Outcome, origin: Origin) -> str:
    """Tables and pictures of a section, and what of it is missing."""
    section, made = found.section, origin.made(found.section)
    parts = [f"## {section.title}", _setting(section)]
    if found.missing:
        parts.append("Not made:\n\n" + "\n".join(f"* {line}" for line in found.missing))
    if found.compared is None:
        return "\n\n".join([*parts, f"Nothing of this section could be made ({made})."])
    results, labels = found.compared.results, _labels()
    cells = results.cells
    for views in cells.view_sets():
        parts += [f"### {TITLES[views]}", values_table(cells, views), made]
        if questions := questions_table(cells, views):
            parts += ["Differences:", questions, made]
    parts += ["### Work", work_table(cells, labels).markdown(), made]
    parts += ["### Roles of the frames", roles_table(results.roles, labels).markdown(), made]
    if results.choices:
        parts += ["### The choice against the truth", choices_table(results.choices, labels).markdown(), made]
    elif section.kind == "video":
        parts.append("Whether RIVR chose well cannot be said here: the repaired frames have no truth.")
    parts += [
        f"![Differences, {section.title}](results/{section.name}.png)",
        f"![Truth, input and scenes, {section.title}](results/{section.name}-sheet.jpg)",
        made,
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
    return "; ".join(parts) + "."
