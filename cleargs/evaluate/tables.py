"""The tables of a comparison, as Markdown."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from cleargs.evaluate.cells import Cells, Spread, ViewSet
from cleargs.evaluate.results import LOWER_IS_BETTER

TITLES: Mapping[ViewSet, str] = {
    "observed": "At the input's true poses, against the sharp truth",
    "given": "At the poses as given (noisy), against the sharp truth",
    "novel": "At novel views off the path, against the sharp truth",
    "held-out": "On held-out frames",
    "reference": "Against the given reference",
}
NAMES = {"psnr": "PSNR", "ssim": "SSIM", "lpips_alex": "LPIPS (AlexNet)", "lpips_vgg": "LPIPS (VGG)"}
_DIGITS = {"psnr": 2, "ssim": 4, "lpips_alex": 4, "lpips_vgg": 4}


def metric_title(metric: str) -> str:
    """Name and direction of a metric, as a heading."""
    return f"{NAMES.get(metric, metric)} {'↓' if metric in LOWER_IS_BETTER else '↑'}"


def markdown(cells: Cells, labels: Mapping[str, str], baselines: Sequence[str]) -> str:
    """All tables: per set of views one table a metric, differences to the baselines; then the cost.

    ``labels`` maps each variant to what it is called. A mean stands with the sample standard deviation where
    there are several samples; a paired difference smaller than its spread is marked as none.
    """
    parts = []
    for views in cells.view_sets():
        parts.append(f"## {TITLES[views]}")
        for metric in cells.metrics():
            parts.append(f"### {metric_title(metric)}")
            parts.append(_metric_table(cells, labels, views, metric))
        for baseline in baselines:
            if baseline in cells.variants():
                parts.append(f"### Minus {labels[baseline]}")
                parts.append(_difference_table(cells, labels, views, baseline))
    parts += ["## Cost", _cost_table(cells, labels)]
    return "\n\n".join(parts) + "\n"


def _metric_table(cells: Cells, labels: Mapping[str, str], views: ViewSet, metric: str) -> str:
    columns = cells.columns(views)
    rows = []
    for variant in cells.variants():
        row = [labels[variant]]
        for column in columns:
            found = cells.spread(views, column, variant, metric)
            text = _value(found, metric)
            row.append(f"**{text}**" if variant == cells.best(views, column, metric) else text)
        rows.append(row)
    return table(["", *columns], rows)


def _difference_table(cells: Cells, labels: Mapping[str, str], views: ViewSet, baseline: str) -> str:
    """PSNR, SSIM and LPIPS of every other variant minus the baseline's; for LPIPS the share of it too."""
    columns = cells.columns(views)
    metrics = [metric for metric in ("psnr", "ssim", "lpips_alex", "lpips_vgg") if metric in cells.metrics()]
    rows = []
    for variant in cells.variants():
        if variant == baseline:
            continue
        for metric in metrics:
            row = [labels[variant], NAMES[metric]]
            for column in columns:
                difference = cells.difference(views, column, variant, baseline, metric)
                row.append(_difference(difference, cells.spread(views, column, baseline, metric), metric))
            rows.append(row)
    return table(["", "", *columns], rows)


def _cost_table(cells: Cells, labels: Mapping[str, str]) -> str:
    """Mean wall seconds a sample: stages of the variant's own + stages shared with variants above it."""
    views = cells.view_sets()[0]
    columns = cells.columns(views)
    rows = []
    for variant in cells.variants():
        row = [labels[variant]]
        for column in columns:
            chosen = [
                cell
                for cell in cells.cells
                if (cell.views, cell.column, cell.variant) == (views, column, variant)
            ]
            own = sum(cell.seconds for cell in chosen) / len(chosen) if chosen else 0.0
            shared = sum(cell.shared_seconds for cell in chosen) / len(chosen) if chosen else 0.0
            row.append(f"{own:.0f} s + {shared:.0f} s" if chosen else "")
        rows.append(row)
    return table(["own + shared stages", *columns], rows)


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A Markdown table."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def number(value: float, metric: str) -> str:
    """A value with the digits that its metric deserves."""
    return f"{value:.{_DIGITS.get(metric, 2)}f}"


def _value(found: Spread | None, metric: str) -> str:
    if found is None:
        return "n/a"
    text = number(found.mean, metric)
    return text if found.deviation is None else f"{text} ± {number(found.deviation, metric)}"


def _difference(found: Spread | None, base: Spread | None, metric: str) -> str:
    if found is None:
        return "n/a"
    digits = _DIGITS.get(metric, 2)
    text = f"{found.mean:+.{digits}f}"
    if found.deviation is not None:
        text += f" ± {found.deviation:.{digits}f}"
    if found.is_none:
        return f"none ({text})"
    if metric in LOWER_IS_BETTER and base is not None and base.mean > 0:
        text += f" ({100 * found.mean / base.mean:+.0f} %)"
    return text
