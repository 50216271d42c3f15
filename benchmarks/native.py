"""A room with all frames of its video, as a capture with true poses."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow.parquet as pq

from cleargs.errors import InputError
from cleargs.files import link_or_copy, write_json
from cleargs.media.image import write_rgb
from cleargs.media.video import decode_frames, read_timeline
from cleargs.safe_io import read_json


def write_native(room: Path, out: Path, *, chosen: bool) -> None:
    """Write the frames of ``room``, made by `cleargs synth --video`, as numbered images with true poses.

    The frames of the capture are its images, those between them are from its video. An ingest that takes as
    many frames as the capture has takes its frames. With ``chosen``, only these are written. The reference
    views are those of the room.

    Raises InputError if the room has no video of all frames.
    """
    table = room / "truth" / "motion.parquet"
    if not table.is_file():
        raise InputError(f"{room} has no true motion", hint="make it with cleargs synth --video")
    truth = {row["video_frame"]: row for row in pq.read_table(table).to_pylist()}
    images = {number: room / row["image"] for number, row in truth.items() if row["image"]}
    suffix = next(iter(images.values())).suffix
    names = {number: f"images/{number:06d}{suffix}" for number in images}
    for number, name in names.items():
        link_or_copy(images[number], _made(out / name))
    if not chosen:
        pts = read_timeline(room / "capture.mp4").pts
        between = range(min(images), max(images) + 1)
        numbers = {pts[number]: number for number in between if number not in images}
        for stamp, frame in decode_frames(room / "capture.mp4", list(numbers)):
            names[numbers[stamp]] = f"images/{numbers[stamp]:06d}.png"
            write_rgb(_made(out / names[numbers[stamp]]), frame)
    entries = []
    for number in sorted(names):
        pose = np.vstack([np.reshape(truth[number]["world_to_camera"], (3, 4)), [0.0, 0.0, 0.0, 1.0]])
        matrix = np.linalg.inv(pose) @ np.diag([1.0, -1.0, -1.0, 1.0])  # to the axes of OpenGL
        entries.append({"file_path": names[number], "transform_matrix": matrix.tolist()})
    write_json(out / "transforms.json", read_json(room / "transforms.json") | {"frames": entries})
    for kind in ("observed", "novel"):
        views = read_json(room / "truth" / kind / "transforms.json")
        for index, entry in enumerate(views["frames"]):
            file = room / "truth" / kind / entry["file_path"]
            if kind == "observed":
                entry["file_path"] = f"images/{sorted(images)[index]:06d}.png"
            link_or_copy(file, _made(out / "truth" / kind / entry["file_path"]))
        write_json(out / "truth" / kind / "transforms.json", views)
    link_or_copy(room / "truth" / "capture.json", out / "truth" / "capture.json")


def _made(path: Path) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    return path
