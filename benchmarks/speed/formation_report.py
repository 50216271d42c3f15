"""Table and plot of the benchmark of image formation."""

from __future__ import annotations

from pathlib import Path

from benchmarks.speed.formation_cost import FORMED, PLAIN, FormationBenchmark
from benchmarks.speed.markdown import machine_line, milliseconds, table
from benchmarks.speed.plots import COLOURS, save, show_plain_numbers


def formation_markdown(benchmark: FormationBenchmark) -> str:
    """Return the table with an explanation of its figures."""
    plan = benchmark.plan
    rows = [
        [
            f"{row.length:g}",
            name,
            milliseconds(row.times[name]),
            f"{row.ratio[name].median:.2f}",
            f"{row.psnr[name]:.1f}",
        ]
        for row in benchmark.rows
        for name in row.times
    ]
    head = [
        "blur, px",
        "frame compared with",
        "ms per step",
        "relative to a plain step",
        "PSNR to the exposure, dB",
    ]
    return (
        "\n\n".join(
            [
                "# Speed and error of image formation",
                machine_line(benchmark.machine),
                f"About {plan.gaussians:,} splats of SH degree 3 on two surfaces at {plan.width}x"
                f"{plan.height}, {plan.threads} threads. A step is forward pass, loss, backward pass and "
                "Adam. Times are median [quartiles]; methods are timed alternately in one process. The "
                "exposure is the mean in linear light of many renders along the true path. Half of the blur "
                "is a translation, half a rotation.",
                table(head, rows),
            ]
        )
        + "\n"
    )


def plot_formation(path: Path, benchmark: FormationBenchmark) -> None:
    """Write a PNG: relative time of a step (horizontal) against the PSNR to the exposure (vertical)."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, panel = pyplot.subplots(figsize=(7, 4.8), layout="constrained")
    for row, colour in zip(benchmark.rows, COLOURS, strict=False):
        points = {name: (row.ratio[name].median, row.psnr[name]) for name in row.times}
        renders = [point for name, point in points.items() if name not in (PLAIN, FORMED)]
        panel.plot(*zip(*renders, strict=True), "o-", color=colour, label=f"{row.length:g} px: renders")
        panel.plot(*points[PLAIN], "x", color=colour, label=f"{row.length:g} px: {PLAIN}")
        panel.plot(*points[FORMED], "*", color=colour, markersize=14, label=f"{row.length:g} px: {FORMED}")
    counts = ", ".join(map(str, benchmark.plan.renders))
    panel.set_title(f"A step on a blurred frame; lines: {counts} renders")
    panel.set_xlabel("time relative to a plain step")
    panel.set_ylabel("PSNR to the true exposure, dB")
    panel.set_xscale("log")
    show_plain_numbers(panel.xaxis)
    panel.grid(alpha=0.3)
    panel.legend(fontsize=7)
    save(figure, path)
