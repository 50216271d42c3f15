"""Plots of a benchmark: speed against error, and scaling with the number of pairs."""

from __future__ import annotations

from itertools import cycle
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from benchmarks.speed.benchmark_results import Benchmark, ResultRow
from benchmarks.speed.iteration import WHOLE
from benchmarks.speed.scaling import straight_line
from cleargs.files import atomic_path

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure

COLOURS = ("tab:blue", "tab:orange", "tab:green", "tab:purple", "tab:brown", "tab:pink")
MARKERS = "os^Dvp"

FLOAT32_ROUNDING = 2.0**-24
MIN_RANGE = (3e-8, 1e-4)
"""Minimum range of errors on the axis, so that differences of a few percent do not look large."""


def plot_speed_error(path: Path, benchmark: Benchmark) -> None:
    """Write a PNG of time (horizontal) against the largest gradient error (vertical), on all threads.

    The left panel shows the rasterisers, with a line from ours to torch's for each case. The right panel
    shows training iterations.
    """
    figure, (rasterisers, iterations) = _panels()
    threads = max(benchmark.threads)
    _rasterisers(rasterisers, benchmark.rows, threads)
    counts = sorted({row.case.gaussians for row in benchmark.rows})
    sizes = sorted({row.case.width * row.case.height for row in benchmark.rows})
    for row in benchmark.rows:
        iterations.plot(
            row.times[threads][WHOLE].median,
            row.accuracy.worst_gradient,
            MARKERS[sizes.index(row.case.width * row.case.height) % len(MARKERS)],
            color=COLOURS[counts.index(row.case.gaussians) % len(COLOURS)],
            label=row.case.title,
        )
    rasterisers.set_title("Rasteriser, forward and backward")
    iterations.set_title("Training iteration")
    for panel in (rasterisers, iterations):
        panel.set_xlabel(f"ms on {threads} threads" if threads > 1 else "ms on 1 thread")
        panel.set_ylabel("largest gradient error against float64")
        show_plain_numbers(panel.xaxis)
        low, high = panel.get_ylim()
        panel.set_ylim(min(low, MIN_RANGE[0]), max(high, MIN_RANGE[1]))
        panel.axhline(FLOAT32_ROUNDING, color="0.5", linestyle=":", label="rounding of a float32")
    _legend(rasterisers)
    handles, names = iterations.get_legend_handles_labels()
    figure.legend(handles, names, loc="outside right center", fontsize=7, frameon=False)
    save(figure, path)


def _rasterisers(panel: Axes, rows: list[ResultRow], threads: int) -> None:
    """Plot the rasterisers: a colour per case, a marker per rasteriser."""
    compared = [(row, row.rasterisers) for row in rows if row.rasterisers is not None]
    markers: dict[str, str] = {}
    for (row, found), colour in zip(compared, cycle(COLOURS), strict=False):
        points = {"ours": (found.ours[threads].median, row.accuracy.worst_gradient)}
        points["torch"] = (found.torch.times[threads].median, found.torch.accuracy.worst_gradient)
        x, y = zip(*points.values(), strict=True)
        panel.plot(x, y, color=colour, linewidth=0.8, label=row.case.title)
        for (name, point), marker in zip(points.items(), MARKERS, strict=False):
            panel.plot(*point, marker, color=colour)
            markers[name] = marker
    for name, marker in markers.items():
        panel.plot([], [], marker, color="0.3", label=name)


def plot_scaling(path: Path, benchmark: Benchmark) -> None:
    """Write a PNG of time and memory against the number of pairs, with the best linear fits."""
    figure, (times, memory) = _panels()
    times.set_ylabel("ms, forward and backward")
    memory.set_ylabel("peak memory, MB")
    show_plain_numbers(times.yaxis)
    show_plain_numbers(memory.yaxis)
    for (name, points), marker, colour in zip(benchmark.scaling.items(), MARKERS, COLOURS, strict=False):
        measured = [(point.pairs, point.milliseconds.median) for point in points]
        known = [(point.pairs, point.memory / 1e6) for point in points if point.memory is not None]
        for panel, values in ((times, measured), (memory, known)):
            if values:
                panel.plot(*zip(*values, strict=True), marker, color=colour, label=name)
                _line(panel, values, colour)
        for point in points:
            quartiles = (point.milliseconds.low, point.milliseconds.high)
            times.plot((point.pairs, point.pairs), quartiles, color=colour)
    for panel in (times, memory):
        panel.set_xlabel("(tile, splat) pairs")
        _legend(panel)
    save(figure, path)


def _line(panel: Axes, values: list[tuple[int, float]], colour: str) -> None:
    line = straight_line(values)
    numbers = np.geomspace(min(x for x, _ in values), max(x for x, _ in values), 50)
    panel.plot(
        numbers, line.offset + line.slope * numbers, "--", color=colour, linewidth=1, label="best linear fit"
    )


def _panels() -> tuple[Figure, tuple[Axes, Axes]]:
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, (left, right) = pyplot.subplots(1, 2, figsize=(12, 4.8), layout="constrained")
    for panel in (left, right):
        panel.set_xscale("log")
        panel.set_yscale("log")
        panel.grid(alpha=0.3)
    return figure, (left, right)


def show_plain_numbers(axis: Axis) -> None:
    """Label the axis with 1, 2, 5, 10, ... instead of powers of ten."""
    from matplotlib.ticker import LogLocator, NullFormatter

    axis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axis.set_major_formatter("{x:g}")
    axis.set_minor_formatter(NullFormatter())


def _legend(panel: Axes) -> None:
    handles, names = panel.get_legend_handles_labels()
    once = dict(zip(names, handles, strict=True))
    panel.legend(once.values(), once.keys(), fontsize=7)


def save(figure: Figure, path: Path) -> None:
    """Write a PNG and close the figure."""
    from matplotlib import pyplot

    with atomic_path(path) as temporary:
        figure.savefig(temporary, format="png", dpi=110)
    pyplot.close(figure)
