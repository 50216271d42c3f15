"""``cleargs synth``: captures with known truth."""

from __future__ import annotations

import re
from pathlib import Path

import click

from cleargs.cli.progress import make_reporter
from cleargs.errors import InputError
from cleargs.synth.protocols import PROTOCOLS


def _size(context: click.Context, parameter: click.Parameter, value: str) -> tuple[int, int]:
    match = re.fullmatch(r"(\d+)x(\d+)", value)
    if not match or not all(16 <= int(side) <= 8192 for side in match.groups()):
        raise click.BadParameter("write WIDTHxHEIGHT in pixels, 480x270 say (16 to 8192 a side)")
    return int(match[1]), int(match[2])


@click.command(
    epilog="""\b
Example:
  cleargs synth room --protocol mixed --frames 16 --size 480x270
  cleargs run room -o run                        uses the exact poses
  cleargs run room -o run --set ingest.poses=sfm  starts from the images alone
"""
)
@click.argument("out", type=click.Path(path_type=Path, file_okay=False))
@click.option("--protocol", default="mixed", show_default=True, help=f"One of {', '.join(PROTOCOLS)}.")
@click.option(
    "--frames", default=16, show_default=True, type=click.IntRange(2, 2000), help="How many frames."
)
@click.option("--size", default="480x270", show_default=True, callback=_size, help="Image size.")
@click.option("--seed", default=0, show_default=True, type=click.IntRange(0), help="Another room and walk.")
def synth(out: Path, protocol: str, frames: int, size: tuple[int, int], seed: int) -> None:
    """Make a synthetic handheld capture of a procedural room in the new folder OUT.

    OUT/images and OUT/transforms.json are a capture like any other; OUT/truth holds the sharp views,
    views off the path, and what is wrong with each frame.
    """
    if protocol not in PROTOCOLS:
        raise InputError(f"no protocol is called {protocol!r}", hint=f"choose one of {', '.join(PROTOCOLS)}")
    from cleargs.synth.capture import make_capture

    make_capture(
        out, protocol, frames=frames, width=size[0], height=size[1], seed=seed, reporter=make_reporter()
    )
    click.echo(f"{frames} frames of {protocol!r} in {out}; the truth in {out / 'truth'}")
