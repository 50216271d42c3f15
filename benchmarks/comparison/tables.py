"""Tables of a comparison as Markdown."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from benchmarks.comparison.cells import Cells, Spread, ViewSet
from benchmarks.comparison.choices import Choices, agreement
from benchmarks.comparison.roles import KINDS, Roles
from cleargs.evaluate.eval_report import LOWER_IS_BETTER

TITLES: Mapping[ViewSet, str] = {
    "observed": "At the input's true poses, against the sharp truth",
    "given": "At the poses as given (noisy), against the sharp truth",
    "novel": "At novel views off the path, against the sharp truth",
    "held-out": "On held-out frames",
    "reference": "Against the given reference",
}
NOTES: Mapping[ViewSet, str] = {
    "observed": "Training poses: the scenes were trained on the frames filmed here, not on this truth.",
    "given": "Training poses: the scenes were trained on the frames filmed here, not on this truth.",
    "novel": "No frame was filmed at these poses.",
    "held-out": "No scene was trained on these frames. They may be blurred themselves.",
}
"""Notes on the sets of views."""
UNKNOWN_NOTE = "It is unknown which of these frames the scenes were trained on."
SEEN_NOTE = "Scenes were trained on some of these frames: see the first lines."
NAMES = {"psnr": "PSNR", "ssim": "SSIM", "lpips_alex": "LPIPS (AlexNet)", "lpips_vgg": "LPIPS (VGG)"}
COMPARED = ("psnr", "ssim", "lpips_alex", "lpips_vgg")
"""Metrics in the tables of differences."""
_DIGITS = {"psnr": 2, "ssim": 4, "lpips_alex": 4, "lpips_vgg": 4}


def metric_title(metric: str) -> str:
    """Return the heading of a metric: its name and an arrow to better values."""
    return f"{NAMES.get(metric, metric)} {'↓' if metric in LOWER_IS_BETTER else '↑'}"


class Bold(str):
    """Text of a table cell in bold."""

    __slots__ = ()


@dataclass(frozen=True)
class Table:
    """A table of texts."""

    head: Sequence[str]
    rows: Sequence[Sequence[str]]

    def markdown(self) -> str:
        """Return the table as Markdown."""
        rows = [[f"**{text}**" if isinstance(text, Bold) else text for text in row] for row in self.rows]
        lines = [self.head, ["---"] * len(self.head), *rows]
        return "\n".join("| " + " | ".join(line) + " |" for line in lines)


@dataclass(frozen=True)
class Results:
    """Results that the tables of a comparison show."""

    cells: Cells
    roles: Sequence[Roles]
    choices: Sequence[Choices]


def markdown(found: Results, labels: Mapping[str, str], baselines: Sequence[str]) -> str:
    """Return all tables as Markdown.

    Each set of views has one table per metric and one of differences per baseline. Tables of the work, of the
    roles of the frames and of the choices of RIVR follow. A mean has the sample standard deviation. A paired
    difference has half its 95 % interval (Student's t over the samples) and is marked "none" if the interval
    includes 0.

    Args:
        found: Results of the comparison.
        labels: Variant -> label.
        baselines: Variants that are subtracted from the others.
    """
    cells, parts = found.cells, []
    for views in cells.view_sets():
        parts.append(f"## {TITLES[views]}")
        parts += [note] if (note := note_on(cells, views)) else []
        for metric in cells.metrics():
            parts.append(f"### {metric_title(metric)}")
            parts.append(metric_table(cells, labels, views, metric).markdown())
        for baseline in baselines:
            if baseline in cells.variants():
                parts.append(f"### Minus {labels[baseline]}")
                parts.append(difference_table(cells, labels, views, baseline).markdown())
    parts += [
        "## Work",
        work_table(cells, labels).markdown(),
        "## Roles of the frames",
        roles_table(found.roles, labels).markdown(),
    ]
    if found.choices:
        parts += ["## Choices of RIVR against the truth", choices_table(found.choices, labels).markdown()]
    return "\n\n".join(parts) + "\n"


def note_on(cells: Cells, views: ViewSet) -> str:
    """Return the note on a set of views in this comparison; "" without a note."""
    seen = [cell.trained_on for cell in cells.cells if cell.views == views]
    if views == "held-out" and any(seen):
        return SEEN_NOTE
    return UNKNOWN_NOTE if views == "held-out" and None in seen else NOTES.get(views, "")


def training_lines(cells: Cells, labels: Mapping[str, str]) -> list[str]:
    """Return a note for each scene that is evaluated on frames of its training, unless the views imply it."""
    return [
        f"note: {cell.trained_on} of {cell.images} views of {labels[cell.variant]} show its training frames"
        for cell in cells.cells
        if cell.views in ("held-out", "reference") and cell.trained_on
    ]


def metric_table(cells: Cells, labels: Mapping[str, str], views: ViewSet, metric: str) -> Table:
    """Return the means of a metric by variant and column; the best of a column is bold."""
    rows = [[labels[variant], *value_texts(cells, views, variant, metric)] for variant in cells.variants()]
    return Table(["", *cells.columns(views)], rows)


def value_texts(cells: Cells, views: ViewSet, variant: str, metric: str) -> list[str]:
    """Return a variant's means of a metric by column; bold if it is the best."""
    return [value_text(cells, views, column, variant, metric) for column in cells.columns(views)]


def value_text(cells: Cells, views: ViewSet, column: str, variant: str, metric: str) -> str:
    """Return a variant's mean of a metric in one column; bold if it is the best."""
    text = _value(cells.spread(views, column, variant, metric), metric)
    return Bold(text) if variant == cells.best(views, column, metric) else text


def difference_table(cells: Cells, labels: Mapping[str, str], views: ViewSet, baseline: str) -> Table:
    """Return PSNR, SSIM and LPIPS of every other variant minus those of the baseline.

    Differences are paired within samples and have 95 % intervals. For LPIPS they are also in percent of the
    baseline.
    """
    columns = cells.columns(views)
    metrics = [metric for metric in COMPARED if metric in cells.metrics()]
    rows = []
    for variant in cells.variants():
        if variant == baseline:
            continue
        for metric in metrics:
            row = [labels[variant], NAMES[metric]]
            for column in columns:
                difference = cells.difference(views, column, variant, baseline, metric)
                row.append(difference_text(difference, cells.spread(views, column, baseline, metric), metric))
            rows.append(row)
    return Table(["", "", *columns_with_counts(cells, views)], rows)


def columns_with_counts(cells: Cells, views: ViewSet) -> list[str]:
    """Return the columns with their numbers of samples."""
    found = []
    for column in cells.columns(views):
        samples = {cell.sample for cell in cells.cells if (cell.views, cell.column) == (views, column)}
        found.append(f"{column} (n = {len(samples)})")
    return found


def work_table(cells: Cells, labels: Mapping[str, str]) -> Table:
    """Return the work of each variant: ranges of what must be equal, means over all samples of the rest."""
    rows = []
    for variant in cells.variants():
        # One cell per scene: the cells of all its sets of views have the same work.
        own = [cell for cell in cells.cells if cell.variant == variant]
        chosen = list({(cell.column, cell.sample): cell for cell in own}.values())
        rows.append(
            [
                labels[variant],
                _range(cell.steps for cell in chosen),
                _range(cell.gaussians for cell in chosen),
                _range(cell.sh_degree for cell in chosen),
                _mean([cell.cpu_seconds for cell in chosen], 0),
                _mean([cell.peak_memory_gb for cell in chosen], 2),
                f"{_mean([cell.seconds for cell in chosen], 0)} + "
                f"{_mean([cell.shared_seconds for cell in chosen], 0)}",
            ]
        )
    head = ["", "steps", "Gaussians", "SH degree", "CPU s", "peak memory, GB", "wall s, own + shared stages"]
    return Table(head, rows)


def roles_table(roles: Sequence[Roles], labels: Mapping[str, str]) -> Table:
    """Return the number of frames by role and column, over all samples; equal variants share a row."""
    rows = []
    for column in dict.fromkeys(scene.column for scene in roles):
        groups: dict[tuple[int, ...], list[str]] = {}
        scenes = [scene for scene in roles if scene.column == column]
        for variant in dict.fromkeys(scene.variant for scene in scenes):
            own = [scene.frames for scene in scenes if scene.variant == variant]
            counts = tuple(sum(frames[kind] for frames in own) for kind in KINDS)
            groups.setdefault(counts, []).append(variant)
        for counts, variants in groups.items():
            rows.append([column, ", ".join(labels[name] for name in variants), *map(str, counts)])
    return Table(["", "", *KINDS], rows)


def choices_table(choices: Sequence[Choices], labels: Mapping[str, str]) -> Table:
    """Return how often the chosen repair is the best candidate, over all samples of a column."""
    rows = []
    for column, variant in dict.fromkeys((scene.column, scene.variant) for scene in choices):
        own = [scene for scene in choices if (scene.column, scene.variant) == (column, variant)]
        found = agreement([row for scene in own for row in scene.rows])
        rows.append(
            [
                column,
                labels[variant],
                str(found.kept),
                str(found.repaired),
                *(
                    "n/a" if share is None else f"{100 * share:.0f} %"
                    for share in (found.by_psnr, found.by_lpips, found.by_chance)
                ),
                "n/a" if found.lost_psnr is None else f"{found.lost_psnr:.2f}",
            ]
        )
    head = [
        "",
        "",
        "kept as filmed",
        "repaired",
        "best by PSNR",
        "best by LPIPS (AlexNet)",
        "by chance",
        "PSNR below the best, dB",
    ]
    return Table(head, rows)


def format_value(value: float, metric: str) -> str:
    """Return a value with the number of digits for its metric."""
    return f"{value:.{_DIGITS.get(metric, 2)}f}"


def _range(values: Iterable[int]) -> str:
    found = sorted(set(values))
    return f"{found[0]}" if len(found) == 1 else f"{found[0]} to {found[-1]}"


def _mean(values: Sequence[float | None], digits: int) -> str:
    known = [value for value in values if value is not None]
    return f"{sum(known) / len(known):.{digits}f}" if known else "n/a"


def _value(found: Spread | None, metric: str) -> str:
    if found is None:
        return "n/a"
    text = format_value(found.mean, metric)
    return text if found.deviation is None else f"{text} ± {format_value(found.deviation, metric)}"


def difference_text(found: Spread | None, base: Spread | None, metric: str) -> str:
    """Return a paired difference with half its 95 % interval; with its count if ``base`` has more samples."""
    if found is None:
        return "n/a"
    digits = _DIGITS.get(metric, 2)
    text = f"{found.mean:+.{digits}f}"
    if found.half_width is not None:
        text += f" ± {found.half_width:.{digits}f}"
    pairs = f" (n = {found.count})" if base is not None and found.count < base.count else ""
    if found.includes_zero:
        return f"none ({text}){pairs}"
    if metric in LOWER_IS_BETTER and base is not None and base.mean > 0:
        text += f" ({100 * found.mean / base.mean:+.0f} %)"
    return f"{text}{pairs}"
