"""``world``: make a synthetic capture in a trained scene."""

from __future__ import annotations

from pathlib import Path

import click

from cleargs.cli.common import parse_size
from cleargs.cli.progress_bars import make_reporter
from cleargs.cli.synth import capture_lines


@click.command(
    epilog="""\b
Example:
  python -m benchmarks world blurred --protocol gs2e-medium --scene run/g0/scene.ply
"""
)
@click.argument("out", type=click.Path(path_type=Path, file_okay=False))
@click.option(
    "--scene", required=True, type=click.Path(path_type=Path), metavar="FILE.ply", help="A trained scene."
)
@click.option(
    "--cameras",
    type=click.Path(path_type=Path),
    metavar="DIR|FILE",
    help="Cameras that the path through the scene follows: a transforms.json, its folder, or a run. "
    "Without it, the cameras of the run that contains the scene.",
)
@click.option("--protocol", default="mixed", show_default=True, help="Degradations, as of `cleargs synth`.")
@click.option(
    "--frames", default=16, show_default=True, type=click.IntRange(2, 2000), help="Number of frames."
)
@click.option("--size", default="480x270", show_default=True, callback=parse_size, help="Image size.")
@click.option(
    "--seed",
    default=0,
    show_default=True,
    type=click.IntRange(0),
    help="Seed of the path and the degradations.",
)
def world(
    out: Path, scene: Path, cameras: Path | None, protocol: str, frames: int, size: tuple[int, int], seed: int
) -> None:
    """Make a synthetic handheld capture in a trained scene, in the new folder OUT.

    OUT gets the same files as a capture of ``cleargs synth``.
    """
    from benchmarks.comparison.splat_world import scene_setup
    from cleargs.synth.synthetic_capture import make_capture

    width, height = size
    summary = make_capture(
        out,
        protocol,
        frames=frames,
        width=width,
        height=height,
        seed=seed,
        reporter=make_reporter(),
        setup=scene_setup(scene, cameras, frames, width, height),
    )
    for line in capture_lines(out, summary):
        click.echo(line)
