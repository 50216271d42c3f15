"""Table and plot of the benchmark of qualities."""

from __future__ import annotations

from pathlib import Path

from benchmarks.speed.markdown import UNKNOWN, machine_line, table
from benchmarks.speed.plots import COLOURS, MARKERS, save, show_plain_numbers
from benchmarks.speed.quality_cost import HOLDOUT, QualityBenchmark, QualityRow


def quality_markdown(benchmark: QualityBenchmark) -> str:
    """Return the table with an explanation of its figures."""
    plan = benchmark.plan
    settings = {"ingest.holdout": HOLDOUT, **plan.settings}
    head = [
        "capture",
        "quality",
        "minutes",
        "minutes of training",
        "CPU minutes",
        "memory, GB",
        "steps",
        "Gaussians",
        "PSNR",
        "SSIM",
        "LPIPS (AlexNet)",
    ]
    return (
        "\n\n".join(
            [
                "# Quality and time",
                machine_line(benchmark.machine),
                f"Runs up to `{plan.until}`, {plan.threads} threads; settings "
                f"{', '.join(f'`{name}={value}`' for name, value in settings.items())}. Metrics are means "
                "over held-out frames. Minutes are wall time of all stages; a stage that qualities share ran "
                "once and counts for each. Training is `g0`.",
                table(head, [_cells(row) for row in benchmark.rows]),
            ]
        )
        + "\n"
    )


def _cells(row: QualityRow) -> list[str]:
    return [
        f"{row.capture} ({row.images} held out)",
        row.quality,
        f"{sum(row.seconds.values()) / 60:.1f}",
        f"{row.seconds.get('g0', 0.0) / 60:.1f}",
        UNKNOWN if row.cpu_seconds is None else f"{row.cpu_seconds / 60:.1f}",
        UNKNOWN if row.peak_memory_gb is None else f"{row.peak_memory_gb:.1f}",
        f"{row.steps:,}",
        f"{row.gaussians:,}",
        _figure(row, "psnr", 2),
        _figure(row, "ssim", 4),
        _figure(row, "lpips_alex", 3),
    ]


def _figure(row: QualityRow, metric: str, digits: int) -> str:
    value = row.means[metric]
    return UNKNOWN if value is None else f"{value:.{digits}f}"


def plot_quality(path: Path, benchmark: QualityBenchmark) -> None:
    """Write a PNG: minutes of a run (horizontal) against PSNR on held-out frames (vertical)."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, panel = pyplot.subplots(figsize=(7, 4.8), layout="constrained")
    captures = dict.fromkeys(row.capture for row in benchmark.rows)
    for capture, colour in zip(captures, COLOURS * len(captures), strict=False):
        points = [
            (row.quality, sum(row.seconds.values()) / 60, psnr)
            for row in benchmark.rows
            if row.capture == capture and (psnr := row.means["psnr"]) is not None
        ]
        panel.plot([x for _, x, _ in points], [y for _, _, y in points], color=colour, lw=0.8, label=capture)
        for quality, minutes, psnr in points:
            panel.plot(minutes, psnr, MARKERS[benchmark.plan.qualities.index(quality)], color=colour)
    for quality, marker in zip(benchmark.plan.qualities, MARKERS, strict=False):
        panel.plot([], [], marker, color="0.3", label=quality)
    panel.set_title("Quality and time")
    panel.set_xlabel(f"minutes up to {benchmark.plan.until}, {benchmark.plan.threads} threads")
    panel.set_ylabel("PSNR on held-out frames, dB")
    panel.set_xscale("log")
    show_plain_numbers(panel.xaxis)
    panel.grid(alpha=0.3)
    panel.legend(fontsize=7)
    save(figure, path)
