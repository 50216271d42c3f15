"""The command ``python -m benchmarks native``."""

from __future__ import annotations

from pathlib import Path

import click


@click.command()
@click.argument("room", type=click.Path(exists=True, path_type=Path))
@click.argument("out", type=click.Path(path_type=Path))
@click.option("--chosen", is_flag=True, help="Write the frames of the capture alone, without neighbours.")
def native(room: Path, out: Path, chosen: bool) -> None:
    """Write ROOM with all frames of its video, as a capture with true poses.

    ROOM is a room of `cleargs synth --video` with N frames. Train OUT with --set ingest.max_frames=N. With
    --chosen, OUT has the same N frames without their neighbours.
    """
    from benchmarks.native import write_native

    write_native(room, out, chosen=chosen)
