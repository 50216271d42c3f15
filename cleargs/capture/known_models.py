"""Models that COLMAP made before of the same pictures, in the stage's cache.

A run with other held-out frames has the same working images, and so the same poses and points.
"""

from __future__ import annotations

import hashlib
import io
import json
import zipfile
import zlib
from collections.abc import Sequence
from pathlib import Path

from cleargs.capture.sfm_job import OUTCOME, Job
from cleargs.digest import file_digest
from cleargs.files import make_folder, remove, write_bytes
from cleargs.own_files import regular_files
from cleargs.safe_io import FAULTS, MAX_BYTES, read_bytes

_FAULTS: tuple[type[Exception], ...] = (*FAULTS, zipfile.BadZipFile, zlib.error, RuntimeError)
_FILES = ("cameras.bin", "images.bin", "points3D.bin", OUTCOME)


def file_of(job: Job, cache: Path, program: Sequence[object]) -> Path:
    """Return the file in ``cache`` for the model of ``job``. ``program`` are versions of what makes it."""
    settings = job.model_dump(mode="json", exclude={"folder", "images", "masks", "exif_images", "threads"})
    pictures = [job.images / name for name in job.names]
    masks = sorted(regular_files(job.masks)) if job.masks is not None else []
    stated = [path and file_digest(path) for path in job.exif_images]
    facts = [*program, settings, stated, [(file.name, file_digest(file)) for file in (*pictures, *masks)]]
    return cache / f"{hashlib.sha256(json.dumps(facts).encode()).hexdigest()}.zip"


def take(file: Path, model: Path) -> bool:
    """Write the folder ``model`` from a file of `keep`. Return False if the file is missing or damaged."""
    part = model.with_name(f"{model.name}.kept")
    try:
        with zipfile.ZipFile(io.BytesIO(read_bytes(file))) as archive:
            if sum(archive.getinfo(name).file_size for name in _FILES) > MAX_BYTES:
                return False
            make_folder(part, empty=True)
            for name in _FILES:
                write_bytes(part / name, archive.read(name))
    except _FAULTS:
        remove(part)
        return False
    part.rename(model)
    return True


def keep(model: Path, file: Path) -> None:
    """Write the ``model`` of COLMAP to ``file``, atomically."""
    made = io.BytesIO()
    with zipfile.ZipFile(made, "w", zipfile.ZIP_DEFLATED) as archive:
        for name in _FILES:
            archive.writestr(zipfile.ZipInfo(name), (model / name).read_bytes(), zipfile.ZIP_DEFLATED)
    file.parent.mkdir(parents=True, exist_ok=True)
    write_bytes(file, made.getvalue())
