"""The tables of a comparison, as Markdown."""

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
    "observed": "Training poses: the scenes were trained on the frames filmed from here, not on this truth.",
    "given": "Training poses: the scenes were trained on the frames filmed from here, not on this truth.",
    "novel": "No frame was filmed from these places.",
    "held-out": "No scene was trained on these frames. They are as sharp as they were filmed.",
}
"""What to know of a set of views."""
UNKNOWN = "Which of these frames the scenes were trained on is not known."
SEEN = "Scenes were trained on some of these frames, as the first lines say."
NAMES = {"psnr": "PSNR", "ssim": "SSIM", "lpips_alex": "LPIPS (AlexNet)", "lpips_vgg": "LPIPS (VGG)"}
COMPARED = ("psnr", "ssim", "lpips_alex", "lpips_vgg")
"""Metrics whose differences are tabled."""
_DIGITS = {"psnr": 2, "ssim": 4, "lpips_alex": 4, "lpips_vgg": 4}


def metric_title(metric: str) -> str:
    """Name and direction of a metric, as a heading."""
    return f"{NAMES.get(metric, metric)} {'↓' if metric in LOWER_IS_BETTER else '↑'}"


class Bold(str):
    """A text of a table that stands out."""

    __slots__ = ()


@dataclass(frozen=True)
class Table:
    """Words in rows below a head."""

    head: Sequence[str]
    rows: Sequence[Sequence[str]]

    def markdown(self) -> str:
        """The table as Markdown."""
        rows = [[f"**{text}**" if isinstance(text, Bold) else text for text in row] for row in self.rows]
        lines = [self.head, ["---"] * len(self.head), *rows]
        return "\n".join("| " + " | ".join(line) + " |" for line in lines)


@dataclass(frozen=True)
class Results:
    """All that a comparison found."""

    cells: Cells
    roles: Sequence[Roles]
    choices: Sequence[Choices]


def markdown(found: Results, labels: Mapping[str, str], baselines: Sequence[str]) -> str:
    """All tables: per set of views one table a metric, differences to the baselines; then the work, the roles
    of the frames and how well RIVR chose.

    ``labels`` maps each variant to what it is called. A mean stands with the sample standard deviation, a
    paired difference with half its 95 % interval (Student's t over the samples); one whose interval holds 0
    is marked as none.
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
        parts += ["## The choice against the truth", choices_table(found.choices, labels).markdown()]
    return "\n\n".join(parts) + "\n"


def note_on(cells: Cells, views: ViewSet) -> str:
    """What to know of a set of views in this comparison; "" for nothing."""
    seen = [cell.trained_on for cell in cells.cells if cell.views == views]
    if views == "held-out" and any(seen):
        return SEEN
    return UNKNOWN if views == "held-out" and None in seen else NOTES.get(views, "")


def training_lines(cells: Cells, labels: Mapping[str, str]) -> list[str]:
    """The scenes that are judged on frames that they were trained on, where the views are not called so."""
    return [
        f"note: {cell.trained_on} of {cell.images} views of {labels[cell.variant]} are of frames that it was "
        "trained on"
        for cell in cells.cells
        if cell.views in ("held-out", "reference") and cell.trained_on
    ]


def metric_table(cells: Cells, labels: Mapping[str, str], views: ViewSet, metric: str) -> Table:
    """A metric of every variant by column, the best of a column in bold."""
    rows = [[labels[variant], *value_texts(cells, views, variant, metric)] for variant in cells.variants()]
    return Table(["", *cells.columns(views)], rows)


def value_texts(cells: Cells, views: ViewSet, variant: str, metric: str) -> list[str]:
    """A variant's values of a metric by column, in bold where it is the best."""
    return [value_text(cells, views, column, variant, metric) for column in cells.columns(views)]


def value_text(cells: Cells, views: ViewSet, column: str, variant: str, metric: str) -> str:
    """A variant's value of a metric in one column, in bold where it is the best."""
    text = _value(cells.spread(views, column, variant, metric), metric)
    return Bold(text) if variant == cells.best(views, column, metric) else text


def difference_table(cells: Cells, labels: Mapping[str, str], views: ViewSet, baseline: str) -> Table:
    """PSNR, SSIM and LPIPS of every other variant minus the baseline's, paired within samples, with 95 %
    intervals; for LPIPS the share of the baseline's too.
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
    return Table(["", "", *counted(cells, views)], rows)


def counted(cells: Cells, views: ViewSet) -> list[str]:
    """The columns with their numbers of samples, over which differences are taken."""
    found = []
    for column in cells.columns(views):
        samples = {cell.sample for cell in cells.cells if (cell.views, cell.column) == (views, column)}
        found.append(f"{column} (n = {len(samples)})")
    return found


def work_table(cells: Cells, labels: Mapping[str, str]) -> Table:
    """What each variant was given and what it took: means over all samples, ranges of what must be equal."""
    rows = []
    for variant in cells.variants():
        # One cell a scene: the sets of views share all of this.
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
    """Frames of all samples of a column by role; variants whose counts agree share a row."""
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
    """How often the chosen repair is the best candidate, over all rows of all samples of a column."""
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
        "lost against the best, dB",
    ]
    return Table(head, rows)


def number(value: float, metric: str) -> str:
    """A value with the digits that its metric deserves."""
    return f"{value:.{_DIGITS.get(metric, 2)}f}"


def _range(values: Iterable[int]) -> str:
    found = sorted(set(values))
    return f"{found[0]}" if len(found) == 1 else f"{found[0]} to {found[-1]}"


def _mean(values: Sequence[float | None], digits: int) -> str:
    noted = [value for value in values if value is not None]
    return f"{sum(noted) / len(noted):.{digits}f}" if noted else "n/a"


def _value(found: Spread | None, metric: str) -> str:
    if found is None:
        return "n/a"
    text = number(found.mean, metric)
    return text if found.deviation is None else f"{text} ± {number(found.deviation, metric)}"


def difference_text(found: Spread | None, base: Spread | None, metric: str) -> str:
    """A paired difference with half its 95 % interval; and of how many pairs, where ``base`` has more."""
    if found is None:
        return "n/a"
    digits = _DIGITS.get(metric, 2)
    text = f"{found.mean:+.{digits}f}"
    if found.half_width is not None:
        text += f" ± {found.half_width:.{digits}f}"
    pairs = f" (n = {found.count})" if base is not None and found.count < base.count else ""
    if found.is_none:
        return f"none ({text}){pairs}"
    if metric in LOWER_IS_BETTER and base is not None and base.mean > 0:
        text += f" ({100 * found.mean / base.mean:+.0f} %)"
    return f"{text}{pairs}"
