"""An export format: `cleargs export RUN -o room.csv` writes the positions of the Gaussians as text."""

from pathlib import Path

from cleargs.files import write_bytes
from cleargs.splat.formats import Format
from cleargs.splat.scene import Scene


def write_csv(path: Path, scene: Scene) -> None:
    """Write a scene that was rotated to the axes of the format; the file must appear in one step."""
    rows = (",".join(f"{value:.6g}" for value in row) for row in scene.gaussians.means.tolist())
    write_bytes(path, "\n".join(["x,y,z", *rows, ""]).encode())


CSV = Format(write_csv, axes=(1.0, -1.0, -1.0))  # y up, z back
