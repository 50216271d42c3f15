"""poses_bounds.npy next to images, as LLFF writes it and NeRF, Deblur-NeRF and BAD-NeRF read it."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from pathlib import Path
from tokenize import TokenError
from typing import TYPE_CHECKING

from cleargs.capture.capture import Capture, External, SourceFrame
from cleargs.capture.config import CaptureConfig
from cleargs.capture.folders import (
    chosen,
    image_files,
    image_folders,
    is_wanted,
    listed_pictures,
    mask_externals,
)
from cleargs.errors import InputError
from cleargs.safe_io import FAULTS, faults_as, open_regular

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

_FAULTS: tuple[type[Exception], ...] = (*FAULTS, SyntaxError, TokenError)
"""`FAULTS`, and the errors of Python's tokenizer that NumPy raises for a damaged header."""

POSES_BOUNDS = "poses_bounds.npy"
"""LLFF's file of poses."""


def detect(source: Path, config: CaptureConfig) -> bool:
    return config.uses_poses and (source / POSES_BOUNDS).is_file()


def externals(source: Path, config: CaptureConfig) -> Mapping[str, External]:
    folders = {folder.name: folder for folder in image_folders(source)}
    return {"poses_bounds": source / POSES_BOUNDS, **folders, **mask_externals(source)}


def open_capture(source: Path, config: CaptureConfig) -> Capture:
    """See `Layout.open_capture`.

    Frames have the order of the rows, because users of these data sets hold out every N-th row.
    """
    frames = [frame for frame in read_llff(source) if is_wanted(frame.path, source, config)]
    told = listed_pictures(frames, source, POSES_BOUNDS)
    return Capture("llff", chosen(frames, source, config.max_frames), len(frames), told=told)


def read_llff(root: Path) -> list[SourceFrame]:
    """Return the images of ``root`` with their cameras, in the order of the rows.

    Row i belongs to image i by sorted file name (not natural order), as in LLFF. The images are those of the
    first of ``images/`` and ``images_N/`` with as many as there are rows: some releases keep test views in
    only one folder. Raises InputError for a damaged file, a number of rows that fits no folder, NaN, or
    cameras that no lens has.
    """
    table = read_poses_bounds(root / POSES_BOUNDS)
    folders = {folder.name: sorted(image_files(folder)) for folder in image_folders(root)}
    paths = next((files for files in folders.values() if len(files) == len(table)), None)
    if paths is None:
        counts = ", ".join(f"{name}/ {len(files)}" for name, files in folders.items())
        raise InputError(
            f"{POSES_BOUNDS} has {len(table)} poses, which is not the number of images "
            f"({counts or 'no images/ there'})",
            hint="put back the images that the poses were made from, or set ingest.poses=sfm",
        )
    return [_frame(row, path) for row, path in zip(table, paths, strict=True)]


def read_poses_bounds(path: Path) -> NDArray[np.float64]:  # [N, 17]
    """Return the rows of ``path``: a 3x5 pose, then nearest and farthest depth.

    Pickled arrays are not loaded. InputError is raised if the file contains no such array.
    """
    import numpy as np

    hint = "write it again with LLFF's imgs2poses.py, or set ingest.poses=sfm"
    with faults_as(InputError, f"cannot read {path}", hint=hint, faults=_FAULTS):
        open_regular(path).close()
        # Mapped, so that a damaged header cannot ask for more memory than the file has bytes.
        with warnings.catch_warnings(action="ignore"):  # about headers that Python 2 wrote
            table = np.lib.format.open_memmap(path, mode="r")
        if table.ndim != 2 or table.shape[1] != 17 or table.dtype.kind not in "fiu":
            raise ValueError(f"it holds {table.dtype} of shape {table.shape}, not numbers of shape (N, 17)")
        return np.array(table, np.float64)


def _frame(row: NDArray[np.float64], path: Path) -> SourceFrame:
    import numpy as np

    from cleargs.capture.cameras import pinhole, rigid_pose

    hint = f"correct its row of {POSES_BOUNDS}, remove both row and image, or set ingest.poses=sfm"
    # Columns: the camera's down, right and back axes in the world, its centre, and (height, width, focal).
    down, right, back, centre, (height, width, focal) = row[:15].reshape(3, 5).T
    if not np.isfinite(row[:15]).all() or min(height, width, focal) < 1:
        raise InputError(f"the camera of {path.name} in {POSES_BOUNDS} is not finite", hint=hint)
    pose = rigid_pose(np.column_stack([right, -down, back, centre]), path.name, hint)
    size = round(float(width)), round(float(height))
    # Images may be smaller, in the same proportions.
    camera = pinhole(*size, float(focal), float(focal), size[0] / 2, size[1] / 2)
    return SourceFrame(path.name, path, camera=camera, pose=pose)
