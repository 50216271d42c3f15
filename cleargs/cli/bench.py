"""``cleargs bench``: what the splatting core costs on this machine."""

from __future__ import annotations

from pathlib import Path
from statistics import median

import click

from cleargs.cli.common import json_option, print_json, threads_or_all


@click.group()
def bench() -> None:
    """Measure the splatting core on this machine."""


@bench.command(
    epilog="""\b
Examples:
  cleargs bench train                                    50,000 splats at 640x360
  cleargs bench train --gaussians 10000 --threads 1
"""
)
@click.option(
    "--gaussians", default=50_000, show_default=True, type=click.IntRange(1), help="How many splats."
)
@click.option(
    "--width", default=640, show_default=True, type=click.IntRange(1, 8192), help="Image width, px."
)
@click.option(
    "--height", default=360, show_default=True, type=click.IntRange(1, 8192), help="Image height, px."
)
@click.option("--threads", type=click.IntRange(1), help="Threads; all by default.")
@click.option("--repeats", default=4, show_default=True, type=click.IntRange(1), help="Measurements to take.")
@click.option(
    "--prototype",
    type=click.Path(path_type=Path, file_okay=False),
    help="Folder of another trainer (train.py with main(threads) and TM) to time in turn with ours.",
)
@json_option
def train(
    gaussians: int,
    width: int,
    height: int,
    threads: int | None,
    repeats: int,
    prototype: Path | None,
    as_json: bool,
) -> None:
    """Time one training iteration (SH degree 3): forward, loss, backward, Adam; medians of medians.

    With a prototype the two are measured in turn in one process: quote the ratio, not the milliseconds.
    """
    import torch

    from cleargs.splat.bench import time_iteration, time_prototype
    from cleargs.splat.kernels.runtime import set_threads

    count = threads_or_all(threads)
    torch.set_num_threads(count)
    ours, theirs = [], []
    for _ in range(repeats):
        if prototype is not None:
            theirs.append(time_prototype(prototype, count))
        set_threads(count)
        ours.append(time_iteration(gaussians, width, height))
    row: dict[str, float] = {part: median(run[part] for run in ours) for part in ours[0]}
    if theirs:
        row["prototype"] = median(theirs)
        row["ratio"] = median(run["iteration"] / other for run, other in zip(ours, theirs, strict=True))
    if as_json:
        print_json({"gaussians": gaussians, "width": width, "height": height, "threads": count} | row)
        return
    for part, value in row.items():
        click.echo(f"{part:<10} {value:8.2f}" + ("" if part == "ratio" else " ms"))
