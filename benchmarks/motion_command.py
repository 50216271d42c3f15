"""The command ``python -m benchmarks motion``."""

from __future__ import annotations

from pathlib import Path

import click


@click.command()
@click.argument("capture", type=click.Path(exists=True, path_type=Path))
@click.argument("run", type=click.Path(exists=True, path_type=Path))
@click.option("--plot", type=click.Path(path_type=Path), help="Draw both paths into this SVG or PNG file.")
def motion(capture: Path, run: Path, plot: Path | None) -> None:
    """Compare the motion that RUN measured in the video of CAPTURE with the true one.

    CAPTURE is a room of `cleargs synth --video`. RUN is a run on its capture.mp4.
    """
    from benchmarks.motion import compare
    from benchmarks.motion import plot as draw

    found = compare(capture, run)
    row = found.row()
    click.echo(",".join(row))
    click.echo(",".join(f"{value:.4g}" for value in row.values()))
    if plot is not None:
        draw(found, plot)
