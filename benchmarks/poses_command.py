"""The command ``python -m benchmarks poses``."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import click


@click.command()
@click.argument("captures", nargs=-1, type=click.Path(exists=True, path_type=Path))
@click.option(
    "-o", "--output", required=True, type=click.Path(path_type=Path), help="Folder of the captures."
)
@click.option(
    "--seed", default=1, show_default=True, help="Seed of the rooms that are made without CAPTURES."
)
@click.option("--size", default=320, show_default=True, help="Long side of the images, px.")
def poses(captures: Sequence[Path], output: Path, seed: int, size: int) -> None:
    """Add errors to the poses of CAPTURES, or of synthetic rooms, and print how well they are corrected.

    A capture without poses is reconstructed first. The result counts as true.
    """
    from benchmarks.poses import FIGURES, measure, rooms  # they need pycolmap, which rented GPUs lack

    found = list(captures) or rooms(output, seed, size)
    click.echo(",".join(("capture", "given", *FIGURES)))
    for capture in found:
        for row in measure(capture, output / f"{capture.name}.work", size):
            texts = (f"{value:.4g}" if isinstance(value, float) else value for value in row.values())
            click.echo(",".join(texts))
