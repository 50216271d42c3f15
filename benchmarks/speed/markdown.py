"""Tables of a benchmark as Markdown."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from benchmarks.speed.benchmark_results import Benchmark, Machine, ResultRow, Rooflines, ScalingPoint
from benchmarks.speed.iteration import PARTS, WHOLE
from benchmarks.speed.oracle import MARGIN, Accuracy, Error
from benchmarks.speed.scaling import straight_line
from benchmarks.speed.timing import Quartiles
from cleargs.splat.kernels.cpu.simd import LANES

NOT_RUN = "not run"
UNKNOWN = "unknown"
GROUPS = ("means", "log_scales", "rotations", "logit_opacities", "sh")


def markdown(benchmark: Benchmark) -> str:
    """Return all tables with an explanation of their figures."""
    parts = [
        "# Speed and error of the rasteriser",
        machine_line(benchmark.machine),
        "Times are ms, median [quartiles]; the variants of a table are timed alternately in one process. "
        "Scenes are random splats of SH degree 3, spread evenly over the view, on black.",
        *_iterations(benchmark.rows),
        *_errors(benchmark.rows),
        *_rasterisers(benchmark.rows),
        *_roofline(benchmark.roofline),
        *_scaling(benchmark.scaling, max(benchmark.threads)),
    ]
    return "\n\n".join(parts) + "\n"


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a Markdown table; the first column is left-aligned, the others right-aligned."""
    lines = [head, ["---", *("---:" for _ in head[1:])], *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def milliseconds(value: Quartiles) -> str:
    """Return median [quartiles] with about three digits."""
    digits = 2 if value.median < 10 else 1 if value.median < 100 else 0
    return f"{value.median:.{digits}f} [{value.low:.{digits}f} {value.high:.{digits}f}]"


def megabytes(size: int | None) -> str:
    return UNKNOWN if size is None else f"{size / 1e6:.0f}"


def _error(error: Error) -> str:
    return f"{error.max:.1e} / {error.median:.1e}"


def machine_line(machine: Machine) -> str:
    """Return a line on the machine, the versions and the load."""
    versions = ", ".join(f"{name} {number}" for name, number in machine.versions.items())
    return (
        f"{machine.processor}, {machine.cores} cores; {versions}. "
        f"Load average {machine.load_before:.1f} before, {machine.load_after:.1f} after."
    )


def _iterations(rows: list[ResultRow]) -> list[str]:
    lines = [
        [
            row.case.title,
            str(threads),
            f"{row.pairs:,}",
            *(milliseconds(times[part]) for part in (*PARTS, WHOLE)),
            megabytes(row.memory),
            f"{row.accuracy.image.max:.1e}",
            f"{row.accuracy.worst_gradient:.1e}",
        ]
        for row in rows
        for threads, times in row.times.items()
    ]
    head = ["splats", "threads", "pairs", *PARTS, WHOLE, "peak memory, MB", "image error", "gradient error"]
    return [
        "## A training iteration",
        "Forward pass, L1 + D-SSIM with its gradient, backward pass, Adam. Pairs are (tile, splat) pairs. "
        "Memory is the peak of parameters, moments, gradients and buffers in a separate process. Errors are "
        "the largest ones; the next section explains them.",
        table(head, lines),
    ]


def _errors(rows: list[ResultRow]) -> list[str]:
    lines = [[row.case.title, *accuracy_cells(row.accuracy)] for row in rows]
    left_out = max(row.accuracy.left_out_max for row in rows)
    seeds = ", ".join(sorted({str(row.accuracy.seed) for row in rows}))
    return [
        "## Errors against the float64 oracle",
        "Largest / median error. Errors of the image are absolute. Gradients are those of a random linear "
        "functional of the compared pixels: the largest error is relative to the group's largest gradient, "
        "the median is over the elements' relative errors. "
        f"Pixels are random (seed {seeds}). The oracle leaves out splats below alpha 1/255 at all of them, "
        f"without any effect on the result. Pixels within {MARGIN:g} of a cut-off are not compared; the "
        f"largest error of the image there was {left_out:.1e} (a splat at the cut-off adds up to 3.9e-03).",
        table(["splats", "image", *GROUPS, "pixels", "not compared", "splats seen"], lines),
    ]


def accuracy_cells(found: Accuracy) -> list[str]:
    """Return the cells of a row of errors."""
    return [
        _error(found.image),
        *(_error(found.gradients[group]) for group in GROUPS),
        str(found.pixels),
        str(found.left_out),
        f"{found.gaussians:,}",
    ]


def _rasterisers(rows: list[ResultRow]) -> list[str]:
    lines = []
    for row in rows:
        for threads in row.times:
            if (found := row.rasterisers) is None:
                lines.append([row.case.title, str(threads), *[NOT_RUN] * 6])
                continue
            cells = [
                milliseconds(found.ours[threads]),
                f"{row.accuracy.worst_gradient:.1e}",
                milliseconds(found.torch.times[threads]),
                milliseconds(found.torch.ratio[threads]),
                f"{found.torch.accuracy.image.max:.1e}",
                f"{found.torch.accuracy.worst_gradient:.1e}",
            ]
            lines.append([row.case.title, str(threads), *cells])
    head = ["splats", "threads", "ours", "gradient error"]
    head += ["torch", "torch / ours", "image error", "gradient error"]
    return [
        "## Comparison of rasterisers",
        "Forward and backward pass. Ours includes both kernels and the backward pass to the raw parameters. "
        "Pure torch with autograd goes from projected splats to the image and back to their means, conics, "
        "opacities and colours, dense over stacked tiles; it receives the lists of splats per tile. Its "
        "errors include the oracle's float64 projection.",
        table(head, lines),
    ]


def _roofline(found: Rooflines | None) -> list[str]:
    if found is None:
        return []
    parts = [
        f"## Roofline: {found.case.title}",
        "Operations contribute to a pixel or a parameter; bytes must move between kernel and memory at least "
        "once. Both are counted from the kernels' source (`benchmarks/speed/work.py`); float64 counts like "
        "float32. The minimum time is the larger one of operations and bytes at the measured peaks; reached "
        "is minimum time / time. More than 100 % means that caches deliver bytes faster than memory.",
        f"{found.size.pairs:,} pairs, {found.size.contributions:,} contributions of a splat to a pixel in "
        f"{found.size.vectors:,} vectors of {LANES} pixels: "
        f"{found.size.contributions / max(1, found.size.vectors):.1f} of {LANES} lanes are used.",
    ]
    for threads, roofs in found.kernels.items():
        peaks = found.peaks[threads]
        lines = [
            [
                roof.kernel,
                f"{roof.operations / 1e6:,.1f}",
                f"{roof.bytes / 1e6:,.1f}",
                f"{roof.milliseconds:.2f}",
                f"{roof.operations / roof.milliseconds / 1e6:.1f}",
                f"{roof.bytes / roof.milliseconds / 1e6:.1f}",
                roof.bound,
                f"{100 * roof.fraction:.0f} %",
            ]
            for roof in roofs
        ]
        parts += [
            f"{_plural(threads)}: peak {peaks.gflops:.0f} GFLOP/s (multiply-adds of {LANES} lanes), "
            f"{peaks.gbytes:.1f} GB/s (copy).",
            table(["kernel", "Mop", "MB", "ms", "GFLOP/s", "GB/s", "bound by", "reached"], lines),
        ]
    return parts


def _plural(threads: int) -> str:
    return "1 thread" if threads == 1 else f"{threads} threads"


def _scaling(series: dict[str, list[ScalingPoint]], threads: int) -> list[str]:
    parts = [
        "## Scaling",
        f"Forward and backward pass on {_plural(threads)}, and peak memory, by number of (tile, splat) "
        "pairs. The line below each table is the best linear fit.",
    ]
    for name, points in series.items():
        if not points:
            continue
        lines = [
            [
                f"{point.case.title}, {point.case.sigma:g} px",
                f"{point.pairs:,}",
                milliseconds(point.milliseconds),
                f"{1e6 * point.milliseconds.median / point.pairs:.0f}",
                megabytes(point.memory),
                UNKNOWN if point.memory is None else f"{point.memory / point.pairs:.0f}",
            ]
            for point in points
        ]
        head = ["splats", "pairs", "ms", "ns per pair", "memory, MB", "bytes per pair"]
        parts += [f"### {name.capitalize()}", table(head, lines), _lines(points)]
    return parts


def _lines(points: list[ScalingPoint]) -> str:
    time = straight_line([(point.pairs, point.milliseconds.median) for point in points])
    text = (
        f"Time: {time.offset:.2f} ms and {1e6 * time.slope:.1f} ns per pair, with a deviation of at most "
        f"{100 * time.deviation:.0f} %."
    )
    sizes = [(point.pairs, point.memory / 1e6) for point in points if point.memory is not None]
    if sizes:
        memory = straight_line(sizes)
        text += (
            f" Memory: {memory.offset:.1f} MB and {1e6 * memory.slope:.0f} bytes per pair, with a deviation "
            f"of at most {100 * memory.deviation:.0f} %."
        )
    return text
