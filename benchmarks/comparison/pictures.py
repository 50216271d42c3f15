"""Pictures of a comparison: a plot of the values and a contact sheet of the scenes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from benchmarks.comparison.cells import Cell, Cells, ViewSet
from benchmarks.comparison.tables import TITLES, metric_title
from benchmarks.images import read_rgb_float
from cleargs.capture.folders import image_files
from cleargs.evaluate.eval_report import Evaluation
from cleargs.files import atomic_path
from cleargs.media.contact_sheet import Tile, contact_sheet
from cleargs.media.image import write_rgb
from cleargs.types import ImageF32

if TYPE_CHECKING:
    from matplotlib.axes import Axes

PLOTTED = ("psnr", "ssim", "lpips_alex", "lpips_vgg")
_COLOURS = 10
"""Length of matplotlib's colour cycle. Further variants repeat the colours with another marker."""
_MARKERS = "osD"
_NAME_INCHES = 2.6
"""Width of the longest variant name in the legend."""


def plot_comparison(path: Path, cells: Cells, labels: Mapping[str, str]) -> None:
    """Write a PNG of the differences to the first variant.

    It has one row per metric and one panel per set of views. A point is a variant and column; with several
    samples it has the 95 % interval of the paired difference. For a single variant, the plot shows values.
    """
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    metrics = [metric for metric in PLOTTED if metric in cells.metrics()]
    sets = cells.view_sets()
    column_width = max(1.0, 0.2 * len(cells.variants()))
    widths = [2.5 + column_width * len(cells.columns(views)) for views in sets]
    width = max(9.0, sum(widths))
    figure, panels = pyplot.subplots(
        len(metrics),
        len(sets),
        squeeze=False,
        figsize=(width, 2.6 * len(metrics) + 0.8),
        width_ratios=widths,
        layout="constrained",
    )
    for row, metric in zip(panels, metrics, strict=True):
        for panel, views in zip(row, sets, strict=True):
            _panel(panel, cells, labels, views, metric)
    handles, names = panels[0][0].get_legend_handles_labels()
    figure.legend(handles, names, loc="outside lower center", ncols=int(width / _NAME_INCHES), frameon=False)
    with atomic_path(path) as temporary:
        figure.savefig(temporary, format="png", dpi=100)
    pyplot.close(figure)


def _panel(panel: Axes, cells: Cells, labels: Mapping[str, str], views: ViewSet, metric: str) -> None:
    columns, variants = cells.columns(views), cells.variants()
    baseline, *others = variants
    points = len(others or variants)
    step = min(0.1, 0.9 / points)
    for number, variant in enumerate(others or variants):
        found = [
            cells.difference(views, column, variant, baseline, metric)
            if others
            else cells.spread(views, column, variant, metric)
            for column in columns
        ]
        shown = [(place, value) for place, value in enumerate(found) if value is not None]
        panel.errorbar(
            [place + (number - (points - 1) / 2) * step for place, _ in shown],
            [value.mean for _, value in shown],
            [value.half_width or 0.0 for _, value in shown],
            fmt=_MARKERS[number // _COLOURS % len(_MARKERS)],
            color=f"C{number % _COLOURS}",
            markersize=4,
            label=_escape_dollars(labels[variant]),
        )
    if others:
        panel.axhline(0.0, color="black", linewidth=0.8)
    names = [_escape_dollars(name) for name in columns]
    panel.set_xticks(range(len(columns)), names, rotation=30, ha="right", fontsize=8)
    panel.set_xlim(-0.6, len(columns) - 0.4)
    against = f", minus {_escape_dollars(labels[baseline])}" if others else ""
    panel.set_ylabel(metric_title(metric) + against, fontsize=8)
    panel.set_title(TITLES[views].split(",")[0], fontsize=9)
    panel.grid(axis="y", alpha=0.3)


def _escape_dollars(name: str) -> str:
    """Escape dollar signs: matplotlib reads text between two dollar signs as a formula."""
    return name.replace("$", r"\$")


def comparison_sheet(
    path: Path,
    out: Path,
    cells: Cells,
    labels: Mapping[str, str],
    variants: Sequence[str],
    captures: Mapping[str, Path],
) -> None:
    """Write a contact sheet with one row per column of the tables: truth, input and scenes.

    Each row shows a frame of the first sample of its column, chosen by `_typical_frame`.

    Args:
        path: Image file to write.
        out: Folder of the comparison.
        cells: Cells of the comparison.
        labels: Variant -> label.
        variants: Variants to show.
        captures: Sample -> folder of its capture.
    """
    views = cells.view_sets()[0]
    rows = []
    for column in cells.columns(views):
        first = next(cell for cell in cells.cells if (cell.views, cell.column) == (views, column))
        shown = {
            cell.variant: cell
            for cell in cells.cells
            if (cell.views, cell.sample) == (views, first.sample) and cell.variant in variants
        }
        capture = captures[first.sample]
        name = _typical_frame(out, first, capture)
        tiles = [
            Tile(find_image(capture / "truth" / "observed" / "images", name), f"{column}: truth of {name}"),
            Tile(find_image(capture / "images", name), "input"),
        ]
        for variant, cell in shown.items():
            tiles.append(Tile(find_image(out / cell.evaluation, name), labels[variant]))
        rows.append([tile for tile in tiles if tile.image is not None])
    write_rgb(path, contact_sheet(rows, tile_width=320))


def _typical_frame(out: Path, cell: Cell, capture: Path) -> str:
    """Return the name of a bad frame that is not the worst one.

    Its error against the truth is at the upper quartile of the input frames. Without truth, its PSNR in the
    scene is at the lower quartile.
    """
    truth, observed = capture / "truth" / "observed" / "images", capture / "images"
    evaluation = Evaluation.model_validate_json((out / cell.evaluation / "eval.json").read_bytes())
    errors = {}
    for image in evaluation.images:
        sharp, seen = find_image(truth, image.name), find_image(observed, image.name)
        if sharp is not None and seen is not None and sharp.shape == seen.shape:
            errors[image.name] = float(np.square(sharp - seen).mean(dtype=np.float64))
        else:
            errors[image.name] = -(image.values["psnr"] or 0.0)
    ordered = sorted(errors, key=lambda name: (errors[name], name))
    return ordered[3 * len(ordered) // 4]


def find_image(folder: Path, stem: str) -> ImageF32 | None:
    """Return the image with this stem as float32 sRGB in [0, 1]; None if it does not exist."""
    found = [path for path in image_files(folder) if path.stem == stem] if folder.is_dir() else []
    return read_rgb_float(max(found)) if found else None
