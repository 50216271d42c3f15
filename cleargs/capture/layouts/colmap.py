"""A COLMAP project: images and a sparse model."""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Mapping
from dataclasses import replace
from itertools import chain
from pathlib import Path

from cleargs.capture.capture import Capture, External, SourceFrame
from cleargs.capture.config import CaptureConfig
from cleargs.capture.folders import (
    chosen,
    find_images,
    folders_to_search,
    frame_key,
    image_files,
    is_wanted,
    listed_pictures,
    mask_externals,
    require_most,
)
from cleargs.capture.layouts import llff
from cleargs.capture.layouts.llff import POSES_BOUNDS
from cleargs.capture.model_text import image_lines
from cleargs.digest import is_inside
from cleargs.errors import InputError
from cleargs.safe_io import FAULTS, open_regular

PLACES = (
    "sparse",
    "colmap/sparse",
    "colmap",  # ScanNet++
    "dslr_calibration_undistorted",  # ETH3D
    "dslr_calibration_jpg",
)
"""Folders of sparse models in a capture."""


def detect(source: Path, config: CaptureConfig) -> bool:
    return config.uses_poses and bool(_models(source))


def externals(source: Path, config: CaptureConfig) -> Mapping[str, External]:
    """See `Layout.externals`: the model, and all folders in which its images may be."""
    images: dict[str, External] = {}
    for folder in folders_to_search(source):
        if folder == source:
            images["beside_sparse"] = {path.name: path for path in image_files(source)}
        else:
            images[folder.name] = folder
    if llff.detect(source, config):
        images["poses_bounds"] = source / POSES_BOUNDS
    folder = _largest(source)
    tables = {path.name: path for kind in ("bin", "txt") for path in source.glob(f"*.{kind}")}
    return {**images, **mask_externals(source), "sparse": tables if folder == source else folder}


def open_capture(source: Path, config: CaptureConfig) -> Capture:
    """See `Layout.open_capture`. Images without a pose are frames too: the table has them, unregistered."""
    from cleargs.capture.loose_points import LoosePoints
    from cleargs.capture.model import read_model

    models, folder = _models(source), _largest(source)
    model = read_model(folder)
    posed = {image.name: image for image in model.images.values()}
    outside = [name for name in posed if not is_inside(name)]
    if outside:
        raise InputError(
            f"the COLMAP model lists images outside images/ or hidden in it, such as {outside[0]}",
            hint="put them into images/ and export the model again, or set ingest.poses=sfm",
        )
    root, paths, by_stem = find_images(source, list(posed))
    missing = [name for name in posed if name not in paths]
    if 2 * len(missing) > len(posed) and llff.detect(source, config):
        capture = llff.open_capture(source, config)
        note = (
            f"{len(missing)} of {len(posed)} images of the COLMAP model are missing: {POSES_BOUNDS} is read"
        )
        return replace(capture, notes=(*capture.notes, note))
    if not paths and not folders_to_search(source):
        raise InputError(f"{source} has a sparse model but no images/", hint="put the images into images/")
    notes = list(require_most(missing, len(posed), "the COLMAP model"))
    if len(models) > 1:
        notes.append(
            f"{len(models)} sparse models: {folder.relative_to(source)} is read, which has the most images "
            f"({len(posed)} images)"
        )
    if by_stem:
        notes.append(f"the images of the COLMAP model are found in {root.name}/ by their stems")
    known = set(paths.values())
    stored = {
        path.relative_to(root).as_posix(): path
        for path in image_files(root, below=root != source)
        if path not in known
    }
    frames = []
    for name, path in sorted({**stored, **paths}.items(), key=lambda item: frame_key(item[0])):
        image = posed.get(name)
        camera, pose = (None, None) if image is None else (model.cameras[image.camera_id], image.pose)
        if is_wanted(path, source, config):
            frames.append(SourceFrame(name, path, camera=camera, pose=pose))
    taken = chosen(frames, source, config.max_frames)
    views = Counter(chain.from_iterable(image.point_ids.tolist() for image in model.images.values()))
    seen = any(count > 1 for count in views.values())
    if len(model.point_ids) and not seen:
        notes.append(
            f"no two images see one of the {len(model.point_ids)} points of the COLMAP model, as RealityScan "
            "and laser scanners export it: others are triangulated from the images"
        )
    loose = None
    if model.rgb is not None and len(model.rgb) and not seen:
        loose = LoosePoints(model.xyz, model.rgb)
    sparse = model if seen or model.dropped else None
    told = listed_pictures(frames, source, f"the COLMAP model of {folder.relative_to(source)}/")
    available = tuple(frames)
    return Capture(
        "colmap", taken, len(frames), sparse, loose, available=available, told=told, notes=tuple(notes)
    )


def _models(root: Path) -> dict[Path, int]:
    """Return the folders of sparse models with the number of images of each, ``sparse/0`` first.

    Several programs write the model next to the images, or ``images`` and ``cameras`` alone.
    """
    folders: list[Path] = []
    for sparse in map(root.joinpath, PLACES):
        if sparse.is_dir():
            folders += [*sorted(path for path in sparse.iterdir() if path.name.isdecimal()), sparse]
    found: dict[Path, int] = {}
    for folder in (*folders, root):
        for kind in ("bin", "txt"):
            if (folder / f"images.{kind}").is_file():
                found.setdefault(folder, _number_of_images(folder / f"images.{kind}"))
    return found


def _largest(root: Path) -> Path:
    """Return the folder of the sparse model with the most images, the first of equals."""
    models = _models(root)
    return max(models, key=lambda folder: models[folder])


def _number_of_images(file: Path) -> int:
    """Return the number of images in ``file``, ``images.bin`` or ``images.txt``; 0 if it is damaged."""
    try:
        if file.suffix == ".bin":
            with open_regular(file) as opened:
                return int(struct.unpack("<Q", opened.read(8))[0])
        return len(image_lines(file))
    except FAULTS:
        return 0
