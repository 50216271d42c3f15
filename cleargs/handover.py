"""A capture for other trainers: images, poses, sparse points and split, as nerfstudio and gsplat read them.

nerfstudio (1.1.5, ``nerfstudio_dataparser``) takes the split from ``train_filenames`` and its two siblings,
and the first points from ``ply_file_path``. gsplat's ``simple_trainer`` and Inria's code sort the images of a
COLMAP project by name, and hold out those whose place is a multiple of ``--test_every`` (8).
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from cleargs.capture.model import read_model, write_model
from cleargs.capture.tables import Frame, Points
from cleargs.files import whole_folder, write_bytes, write_json
from cleargs.media.image import to_uint8, write_mask, write_rgb
from cleargs.packed import require_images
from cleargs.pipeline.outputs import check_outputs
from cleargs.pipeline.stages import installed
from cleargs.splat.camera import Camera

SPLIT, POINTS = "split.json", "points.ply"


def write_handover(
    ingest: Path,
    frames: Sequence[Frame],
    points: Points,
    cameras: Mapping[int, Camera],
    target: Path,
    weights: Mapping[int, float] | None,
    repeat: int = 1,
    sharper: Callable[[int], Any] | None = None,
) -> Path:
    """Write a capture into the new folder ``target`` (`cleargs.run_results.Prepared.to_nerfstudio`)."""
    run = ingest.parent
    require_images(run, "writing them")
    check_outputs([target], installed(), run)
    known = {frame.frame_id: 1.0 for frame in frames} if weights is None else weights
    used = [
        frame
        for frame in frames
        if frame.registered and (frame.split == "test" or known.get(frame.frame_id, 0.0) > 0)
    ]
    used, origin = _repeated(used, known, repeat)
    every, order, extra = gsplat_order(used)
    names = {frame.frame_id: Path(frame.image).name for frame in used}
    if every is not None and [frame.frame_id for frame in order] != _by_name(used):
        names |= {frame.frame_id: f"{k:06d}-{names[frame.frame_id]}" for k, frame in enumerate(order)}
    masked = any(frame.mask for frame in used)
    entries = []
    with whole_folder(target) as made:
        (made / "images").mkdir()
        if masked:
            (made / "masks").mkdir()
        for frame in used:
            camera, name = cameras[origin[frame.frame_id].frame_id], names[frame.frame_id]
            image = None
            if sharper is not None and frame.split == "train":
                image = sharper(origin[frame.frame_id].frame_id)
            if image is not None:
                write_rgb(made / "images" / name, to_uint8(image.image))
            else:
                shutil.copyfile(ingest / origin[frame.frame_id].image, made / "images" / name)
            pose = np.linalg.inv(camera.world_to_camera) * [1.0, -1.0, -1.0, 1.0]  # OpenGL axes
            entry: dict[str, Any] = {"file_path": f"images/{name}", "transform_matrix": pose.tolist()}
            entry |= {"fl_x": camera.fx, "fl_y": camera.fy, "cx": camera.cx, "cy": camera.cy}
            entry |= {"w": camera.width, "h": camera.height}
            if masked:  # nerfstudio wants one for each image, or none
                entry["mask_path"] = f"masks/{Path(name).stem}.png"
                _write_mask(ingest, frame, made / entry["mask_path"])
            entries.append(entry)
        files = {frame.frame_id: f"images/{names[frame.frame_id]}" for frame in used}
        train, test = ([files[f.frame_id] for f in used if f.split == kind] for kind in ("train", "test"))
        split = {"train_filenames": train, "val_filenames": test, "test_filenames": test} if test else {}
        document = {"camera_model": "PINHOLE", "ply_file_path": POINTS, **split, "frames": entries}
        write_json(made / "transforms.json", document)
        write_points(made / POINTS, points)
        without = {frame.frame_id for frame in extra}
        listed = {frame_id: name for frame_id, name in names.items() if frame_id not in without}
        _write_model(ingest, points, made / "sparse/0", listed, origin)
        facts = {
            "train": train,
            "test": test,
            "test_every": every,
            "not_in_sparse": [files[frame.frame_id] for frame in extra],
            "names": {files[frame.frame_id]: frame.name for frame in used},
            "weights": {
                files[f.frame_id]: known[origin[f.frame_id].frame_id] for f in used if f.split == "train"
            },
        }
        write_json(made / SPLIT, facts)
    return target


def _repeated(
    frames: Sequence[Frame], weights: Mapping[int, float], repeat: int
) -> tuple[list[Frame], dict[int, Frame]]:
    """Repeat each training frame ``repeat`` times its weight, rounded, and at least once.

    Copies have another frame_id and image. The second value is frame_id -> the frame that was copied.
    """
    found, origin = [], {frame.frame_id: frame for frame in frames}
    for frame in frames:
        found.append(frame)
        times = round(repeat * weights[frame.frame_id]) if frame.split == "train" and repeat > 1 else 1
        for number in range(2, times + 1):
            image = Path(frame.image)
            name = image.with_name(f"{image.stem}-{number}{image.suffix}").as_posix()
            found.append(replace(frame, frame_id=max(origin) + 1, image=name))
            origin[found[-1].frame_id] = frame
    return found, origin


def gsplat_order(frames: Sequence[Frame]) -> tuple[int | None, list[Frame], list[Frame]]:
    """Return ``--test_every`` and the order of the images for which gsplat has the same split.

    Without held-out frames, or with more of them than training frames, ``--test_every`` is None and the order
    is that of ``frames``. The third value are held-out frames that no order allows, evenly chosen.
    """
    train, test = ([frame for frame in frames if frame.split == kind] for kind in ("train", "test"))
    if not test or len(test) > len(train):
        return None, list(frames), []
    for every in range(2, len(frames) + 1):  # the order as it is
        if all((frame.split == "test") == (k % every == 0) for k, frame in enumerate(frames)):
            return every, list(frames), []
    gap = -(-len(train) // len(test))  # training frames after each held-out one
    count = -(-len(train) // gap)
    kept = [test[k] for k in np.linspace(0, len(test) - 1, count).round().astype(int)]
    order = []
    for k, frame in enumerate(kept):
        order += [frame, *train[k * gap : (k + 1) * gap]]
    return gap + 1, order, [frame for frame in test if frame not in kept]


def _by_name(frames: Sequence[Frame]) -> list[int]:
    return [frame.frame_id for frame in sorted(frames, key=lambda frame: Path(frame.image).name)]


def _write_mask(folder: Path, frame: Frame, target: Path) -> None:
    if frame.mask:
        shutil.copyfile(folder / frame.mask, target)
    else:
        write_mask(target, np.full((frame.height, frame.width), 255, np.uint8))


def _write_model(
    ingest: Path, points: Points, folder: Path, names: Mapping[int, str], origin: Mapping[int, Frame]
) -> None:
    """Write the COLMAP model of ingest with the new names of its images, which have frame_id + 1 as id."""
    model = read_model(ingest / "colmap/sparse/0")
    images = {
        key + 1: replace(model.images[origin[key].frame_id + 1], name=name) for key, name in names.items()
    }
    write_model(folder, replace(model, images=images), points.observed_rgb)


def write_points(path: Path, points: Points) -> None:
    """Write the sparse points as a PLY, as Open3D and nerfstudio read it."""
    fields = [*((axis, "<f4") for axis in "xyz"), *((name, "u1") for name in ("red", "green", "blue"))]
    vertex = np.empty(len(points.xyz), fields)
    for k, (name, _) in enumerate(fields):
        vertex[name] = points.xyz[:, k] if k < 3 else points.rgb[:, k - 3]
    kinds = {"<f4": "float", "u1": "uchar"}
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(vertex)}"]
    lines += [f"property {kinds[kind]} {name}" for name, kind in fields]
    write_bytes(path, ("\n".join([*lines, "end_header"]) + "\n").encode() + vertex.tobytes())
