"""Commands that measure the speed and the error of ClearGS on this machine."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal, get_args

import click

from cleargs.cli.common import json_option, output_option, print_json, quiet_option
from cleargs.cli.progress_bars import make_reporter
from cleargs.pipeline.session import resolve_device, usable_cores
from cleargs.splat.config import Quality


@click.command(
    epilog="""\b
Examples:
  python -m benchmarks splat -o bench            all sizes; tables, JSON and pictures
  python -m benchmarks splat --quick             the same tables, small sizes
  python -m benchmarks splat -o bench --device cuda   a GPU, compared with gsplat if it is installed

How to read the tables: docs/speed.md.
"""
)
@output_option("Folder to fill.", "out", required=False)
@click.option("--quick", is_flag=True, help="Use small sizes, to try the command; do not quote the figures.")
@click.option(
    "--threads", type=click.IntRange(1), help="Number of threads to measure besides 1.  [default: all cores]"
)
@click.option(
    "--seed", default=0, show_default=True, type=click.IntRange(0), help="Seed for the oracle's pixels."
)
@click.option(
    "--device",
    type=click.Choice(["cpu", "cuda"]),
    default="cpu",
    show_default=True,
    help="Device to measure.",
)
@json_option
@quiet_option
def splat(
    out: Path | None,
    quick: bool,
    threads: int | None,
    seed: int,
    device: Literal["cpu", "cuda"],
    as_json: bool,
    quiet: bool,
) -> None:
    """Measure speed and error of the rasteriser: 10,000 to 400,000 splats, 320x180 to 1280x720.

    Measures forward and backward pass, loss, Adam and memory, on 1 thread and on all. Compares image and
    gradients with a float64 oracle, the time with a rasteriser in pure torch, and each kernel with the peaks
    of the machine. With -o, the folder gets splat.md, splat.json, speed-error.png and scaling.png. Without
    it, the tables are printed.

    On a GPU: 100,000 to 3,000,000 splats at 1280x720 and 1920x1080, compared with gsplat. The folder gets
    splat-cuda.md and splat-cuda.json.
    """
    if device == "cuda":
        if threads is not None:
            raise click.UsageError("--threads only applies to --device cpu")
        _splat_on_gpu(out, quick=quick, seed=seed, as_json=as_json, quiet=quiet)
        return
    import dataclasses

    from benchmarks.speed.benchmark import run
    from benchmarks.speed.benchmark_plan import full_plan, quick_plan
    from benchmarks.speed.markdown import markdown
    from benchmarks.speed.plots import plot_scaling, plot_speed_error
    from cleargs.files import write_bytes, write_json
    from cleargs.splat.kernels.cpu.backend import warm_up

    counts = tuple(sorted({1, threads or usable_cores()}))
    plan = (quick_plan if quick else full_plan)(counts)
    warm_up()
    benchmark = run(dataclasses.replace(plan, seed=seed), make_reporter(quiet))
    text, values = markdown(benchmark), benchmark.as_json()
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
        write_bytes(out / "splat.md", text.encode())
        write_json(out / "splat.json", values)
        plot_speed_error(out / "speed-error.png", benchmark)
        plot_scaling(out / "scaling.png", benchmark)
    _print_results(text, values, out and out / "splat.md", as_json)


def _splat_on_gpu(out: Path | None, *, quick: bool, seed: int, as_json: bool, quiet: bool) -> None:
    import dataclasses

    resolve_device("cuda", click.echo)
    import torch

    from benchmarks.speed.benchmark_plan import device_plan, quick_device_plan
    from cleargs.files import write_bytes, write_json
    from cleargs.splat.kernels.cuda import support

    device = torch.device("cuda")
    support.require(device)
    from benchmarks.speed.device import run
    from benchmarks.speed.device_markdown import device_markdown

    plan = dataclasses.replace(quick_device_plan() if quick else device_plan(), seed=seed)
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
    for benchmark in run(plan, device, make_reporter(quiet)):
        if out is not None:  # after every case, in case the time on the GPU ends
            write_bytes(out / "splat-cuda.md", device_markdown(benchmark).encode())
            write_json(out / "splat-cuda.json", benchmark.as_json())
    _print_results(device_markdown(benchmark), benchmark.as_json(), out and out / "splat-cuda.md", as_json)


@click.command(
    epilog="""\b
Examples:
  python -m benchmarks train                                    50,000 splats at 640x360
  python -m benchmarks train --gaussians 10000 --threads 1
"""
)
@click.option(
    "--gaussians", default=50_000, show_default=True, type=click.IntRange(1), help="Number of splats."
)
@click.option(
    "--width", default=640, show_default=True, type=click.IntRange(1, 8192), help="Image width, px."
)
@click.option(
    "--height", default=360, show_default=True, type=click.IntRange(1, 8192), help="Image height, px."
)
@click.option("--threads", type=click.IntRange(1), help="Number of threads.  [default: all cores]")
@click.option("--repeats", default=4, show_default=True, type=click.IntRange(1), help="Number of rounds.")
@json_option
def train(gaussians: int, width: int, height: int, threads: int | None, repeats: int, as_json: bool) -> None:
    """Time one training iteration (SH degree 3) and measure its error.

    The parts are forward pass, loss, backward pass and Adam.
    """
    from benchmarks.speed.benchmark import measure
    from benchmarks.speed.benchmark_plan import BenchmarkCase, Plan
    from benchmarks.speed.iteration import PARTS, WHOLE

    count = threads or usable_cores()
    case = BenchmarkCase(gaussians, width, height)
    plan = Plan(cases=(case,), threads=(count,), rounds=repeats, repetitions=5)
    found = measure(case, plan)
    row: dict[str, float | None] = {part: found.times[count][part].median for part in (*PARTS, WHOLE)}
    row["memory_mb"] = None if found.memory is None else found.memory / 1e6
    row["image_error"] = found.accuracy.image.max
    row["gradient_error"] = found.accuracy.worst_gradient
    if as_json:
        print_json({"gaussians": gaussians, "width": width, "height": height, "threads": count} | row)
        return
    for name, value in row.items():
        click.echo(f"{name:<14} {_with_unit(name, value)}")


@click.command(
    epilog="""\b
Examples:
  python -m benchmarks formation -o bench                 formation.md, formation.json, formation.png
  python -m benchmarks formation --quick --json
"""
)
@output_option("Folder to fill.", "out", required=False)
@click.option("--quick", is_flag=True, help="Use small sizes, to try the command; do not quote the figures.")
@click.option("--threads", type=click.IntRange(1), help="Number of threads.  [default: all cores]")
@json_option
@quiet_option
def formation(out: Path | None, quick: bool, threads: int | None, as_json: bool, quiet: bool) -> None:
    """Measure the cost of a training step on a blurred frame, and the error of the simulated blur.

    Compares three kinds of steps for blurs of 3, 10 and 30 px: without blur, with image formation, and with
    the mean of 3 to 17 renders along the path. The true exposure is the mean of many renders.
    """
    from benchmarks.speed.formation_cost import plan_of, run
    from benchmarks.speed.formation_report import formation_markdown, plot_formation
    from cleargs.files import write_bytes, write_json
    from cleargs.splat.kernels.cpu.backend import warm_up

    warm_up()
    benchmark = run(plan_of(quick=quick, threads=threads or usable_cores()), make_reporter(quiet))
    text, values = formation_markdown(benchmark), benchmark.as_json()
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
        write_bytes(out / "formation.md", text.encode())
        write_json(out / "formation.json", values)
        plot_formation(out / "formation.png", benchmark)
    _print_results(text, values, out and out / "formation.md", as_json)


@click.command(
    epilog="""\b
Examples:
  python -m benchmarks quality fox bonsai -o bench                draft and standard
  python -m benchmarks quality fox -o bench --quality high        one of them
  python -m benchmarks quality fox -o bench --until g0 --set ingest.max_size=473
"""
)
@click.argument(
    "captures", metavar="INPUT...", nargs=-1, required=True, type=click.Path(exists=True, path_type=Path)
)
@output_option("Folder to fill; finished runs in it are reused.", "out")
@click.option(
    "--quality",
    "qualities",
    multiple=True,
    type=click.Choice(get_args(Quality)),
    default=("draft", "standard"),
    show_default=True,
    help="Quality to measure; may be repeated.",
)
@click.option("--until", default="consolidate", show_default=True, help="Last stage; its scene is evaluated.")
@click.option(
    "--set",
    "overrides",
    multiple=True,
    metavar="STAGE.FIELD=VALUE",
    help="Change one setting of all runs (cleargs settings lists them).",
)
@click.option("--threads", type=click.IntRange(1), help="Number of threads.  [default: all cores]")
@json_option
@quiet_option
def quality(
    captures: tuple[Path, ...],
    out: Path,
    qualities: tuple[Quality, ...],
    until: str,
    overrides: tuple[str, ...],
    threads: int | None,
    as_json: bool,
    quiet: bool,
) -> None:
    """Measure the time of each --quality on real captures, and its PSNR on held-out frames.

    Runs each capture at each quality, with every eighth frame held out. The folder gets the runs, quality.md,
    quality.json and quality.png. Measure on an idle machine.
    """
    from benchmarks.speed.quality_cost import QualityPlan, run
    from benchmarks.speed.quality_report import plot_quality, quality_markdown
    from cleargs.files import write_bytes, write_json
    from cleargs.pipeline.config import parse_override
    from cleargs.pipeline.settings import flattened
    from cleargs.splat.kernels.cpu.backend import warm_up

    changed = dict(item for text in overrides for item in flattened(parse_override(text)))
    plan = QualityPlan(captures, qualities, changed, until, threads or usable_cores())
    warm_up()
    benchmark = run(plan, out, make_reporter(quiet))
    text, values = quality_markdown(benchmark), benchmark.as_json()
    write_bytes(out / "quality.md", text.encode())
    write_json(out / "quality.json", values)
    plot_quality(out / "quality.png", benchmark)
    _print_results(text, values, out / "quality.md", as_json)


def _print_results(text: str, values: Mapping[str, Any], written: Path | None, as_json: bool) -> None:
    """Print the figures as JSON, or the path of the written tables, or the tables."""
    if as_json:
        print_json(values)
    else:
        click.echo(written or text)


def _with_unit(name: str, value: float | None) -> str:
    if value is None:
        return " unknown"
    if name.endswith("error"):
        return f"{value:8.1e}"
    return f"{value:8.2f}" + ("" if name == "memory_mb" else " ms")
