"""Tables of the benchmark of a GPU as Markdown."""

from __future__ import annotations

from benchmarks.speed.device import DeviceBenchmark, DeviceRow
from benchmarks.speed.iteration import PARTS, WHOLE
from benchmarks.speed.markdown import GROUPS, NOT_RUN, accuracy_cells, megabytes, milliseconds, table


def device_markdown(benchmark: DeviceBenchmark) -> str:
    """Return all tables with an explanation of their figures."""
    versions = ", ".join(f"{name} {number}" for name, number in benchmark.versions.items())
    parts = [
        "# Speed and error of the rasteriser on a GPU",
        f"{benchmark.device}; {versions}.",
        "Times are device time in ms, median [quartiles]. Scenes are random splats of SH degree 3, spread "
        "evenly over the view, on black.",
        "## A training iteration",
        "Forward pass, L1 + D-SSIM with its gradient, backward pass, Adam. Pairs are (tile, splat) pairs; "
        "reached are those before all pixels in their tile are opaque. Memory is the peak of parameters, "
        "moments, gradients and buffers.",
        table(
            ["splats", "pairs", "reached", *PARTS, WHOLE, "peak memory, MB"],
            [_iteration(row) for row in benchmark.rows],
        ),
        "## Comparison with gsplat",
    ]
    if benchmark.gsplat_missing is not None:
        parts.append(f"{NOT_RUN.capitalize()}: {benchmark.gsplat_missing}.")
    else:
        parts += [
            "Forward and backward pass from the raw parameters, timed alternately in one process. The memory "
            "of gsplat includes parameters, gradients and tensors that autograd keeps, but no moments.",
            table(
                ["splats", "ours", "gsplat forward", "gsplat backward", "gsplat / ours", "gsplat memory, MB"],
                [_comparison_row(row) for row in benchmark.rows],
            ),
        ]
    parts += [
        "## Errors against the float64 oracle",
        "Largest / median, as in the benchmark of the CPU (docs/speed.md).",
        table(
            ["splats", "image", *GROUPS, "pixels", "not compared", "splats seen"],
            [
                [f"{row.case.title}, {name}", *accuracy_cells(side.accuracy)]
                for row in benchmark.rows
                for name, side in (("ours", row.ours), ("gsplat", row.gsplat))
                if side is not None
            ],
        ),
    ]
    return "\n\n".join(parts) + "\n"


def _iteration(row: DeviceRow) -> list[str]:
    return [
        row.case.title,
        f"{row.pairs:,}",
        f"{row.reached:,}",
        *(milliseconds(row.ours.times[part]) for part in (*PARTS, WHOLE)),
        megabytes(row.ours.memory),
    ]


def _comparison_row(row: DeviceRow) -> list[str]:
    if row.gsplat is None or row.ratio is None:
        return [row.case.title, *[NOT_RUN] * 5]
    passes = sum(row.ours.times[part].median for part in ("forward", "backward"))
    return [
        row.case.title,
        f"{passes:.2f}",
        *(milliseconds(row.gsplat.times[part]) for part in ("forward", "backward")),
        milliseconds(row.ratio),
        megabytes(row.gsplat.memory),
    ]
