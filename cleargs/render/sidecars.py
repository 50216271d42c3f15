"""Files next to an exported scene: cameras, named views and a COLMAP model."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cleargs.capture.model import read_model, transform_model, write_model
from cleargs.capture.tables import load_points
from cleargs.digest import named_files
from cleargs.errors import InputError
from cleargs.files import disk_errors, write_bytes, write_json
from cleargs.named_views import NamedView
from cleargs.pipeline.outputs import check_outputs
from cleargs.pipeline.stages import installed
from cleargs.splat.camera import Camera, cameras_json
from cleargs.splat.formats import format_of

MODEL = "colmap/sparse/0"


def stem(output: Path) -> str:
    return output.name[: -len(format_of(output)) - 1]


def views_json(
    views: Sequence[NamedView],
    camera: Camera,
    scale: float = 1.0,
    rotation: NDArray[np.float64] | None = None,
    translation: NDArray[np.float64] | None = None,
) -> list[dict[str, Any]]:
    """Return name, position, target, up and horizontal field of view (degrees, of ``camera``) of each view.

    They are in the world of the file: x -> scale rotation x + translation.
    """
    turn = np.eye(3) if rotation is None else rotation
    shift = np.zeros(3) if translation is None else translation
    fov = float(np.degrees(2.0 * np.arctan(0.5 * camera.width / camera.fx)))
    return [
        {
            "name": view.name,
            "position": (scale * turn @ view.position + shift).tolist(),
            "target": (scale * turn @ view.target + shift).tolist(),
            "up": (turn @ [0.0, -1.0, 0.0]).tolist(),
            "fov": fov,
        }
        for view in views
    ]


def write_sidecars(
    output: Path,
    ingest: Path,
    cameras: Sequence[tuple[str, Camera]],
    similarity: Mapping[str, Any],
    *,
    force: bool,
) -> None:
    """Write cameras and COLMAP model next to ``output``. Equal files of an earlier export are kept.

    Raises InputError if a file of another content exists.
    """
    sparse = read_model(ingest / MODEL)
    with tempfile.TemporaryDirectory() as name:
        made = Path(name)
        write_json(made / f"{stem(output)}.cameras.json", cameras_json(cameras, **similarity))
        moved = transform_model(sparse, **similarity) if similarity else sparse
        write_model(made / f"{stem(output)}.colmap/sparse/0", moved, load_points(ingest).observed_rgb)
        for inside, file in named_files(made).items():
            target, content = output.parent / inside, file.read_bytes()
            if target.is_file() and target.read_bytes() != content and not force:
                raise InputError(
                    f"{target} exists already, of another export", hint="choose another name, or give --force"
                )
            check_outputs([target], installed(), ingest.parent)
            with disk_errors(target):
                target.parent.mkdir(parents=True, exist_ok=True)
            write_bytes(target, content)  # replaces a link, and does not write through it
