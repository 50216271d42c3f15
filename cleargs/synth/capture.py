"""Writes a synthetic capture: degraded frames and poses for the user, sharp truth beside them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from cleargs.errors import InputError
from cleargs.files import atomic_path, write_json
from cleargs.media.colour import srgb_from_linear
from cleargs.progress import Reporter
from cleargs.synth.path import HandheldPath, exposure_poses, look_at, make_path
from cleargs.synth.protocols import REFERENCE_WIDTH, Degradation, degradations
from cleargs.synth.raycast import Passes, cast
from cleargs.synth.room import Room, make_room
from cleargs.tables import column, write_table

TRUTH_SCHEMA = pa.schema(
    [
        column("frame_id", pa.int32(), "number of the frame, as in images/"),
        column("image", pa.string(), "file below the capture"),
        column("time_s", pa.float64(), "middle of the exposure, seconds"),
        column("blur_px", pa.float64(), "mean length of the motion path in the image, pixels"),
        column("defocus_px", pa.float64(), "mean radius of the blur disc, pixels"),
        column("exposure_ev", pa.float64(), "exposure error, stops"),
        column("noise", pa.float64(), "deviation of the sensor noise at mid grey, sRGB units"),
    ]
)
SHARP_PASSES = 8
NEAR_FOCUS = 0.45
"""Where a frame out of focus is focused, metres: in front of everything."""


@dataclass(frozen=True)
class Lens:
    """Pinhole intrinsics in pixels, pixel centres at + 0.5."""

    width: int
    height: int

    @property
    def focal(self) -> float:
        """65 degrees across the longer side, as a phone's main camera."""
        return max(self.width, self.height) / 2 / math.tan(math.radians(65) / 2)

    @property
    def intrinsics(self) -> tuple[float, float, float, float]:
        return self.focal, self.focal, self.width / 2, self.height / 2


def _low_discrepancy(count: int) -> NDArray[np.float64]:
    """[count, 2] points that cover the unit square evenly (Roberts' R2 sequence)."""
    steps = np.array([0.7548776662466927, 0.5698402909980532])
    return np.asarray((0.5 + np.arange(count)[:, None] * steps) % 1.0, np.float64)


def _disc(count: int, radius: float) -> NDArray[np.float64]:
    """[count, 2] points of a sunflower spiral on a disc."""
    number = np.arange(count) + 0.5
    angle = number * math.pi * (3 - math.sqrt(5))
    disc = np.sqrt(number / count)[:, None] * np.stack([np.cos(angle), np.sin(angle)], 1)
    return np.asarray(radius * disc, np.float64)


def _sharp(
    room: Room, lens: Lens, pose: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    poses = np.broadcast_to(pose, (SHARP_PASSES, lens.height, 3, 4)).copy()
    passes = Passes(poses, _low_discrepancy(SHARP_PASSES), np.zeros((SHARP_PASSES, 2)), 1.0)
    return cast(room, passes, lens.intrinsics, lens.width, lens.height)


def _blur_length(
    lens: Lens, depth: NDArray[np.float64], poses: NDArray[np.float64], middle: NDArray[np.float64]
) -> float:
    """Mean length in pixels of the paths that the middle view's points take over ``poses`` [S, 3, 4]."""
    fx, fy, cx, cy = lens.intrinsics
    rows, columns = np.mgrid[0.5 : lens.height : 8, 0.5 : lens.width : 8]
    z = depth[rows.astype(int), columns.astype(int)]
    points = np.stack([(columns - cx) / fx * z, (rows - cy) / fy * z, z], -1).reshape(-1, 3)
    world = points @ middle[:, :3].T + middle[:, 3]
    tracks = []
    for pose in poses:
        local = (world - pose[:, 3]) @ pose[:, :3]
        tracks.append(np.stack([fx * local[:, 0] / local[:, 2], fy * local[:, 1] / local[:, 2]], 1))
    return float(np.linalg.norm(np.diff(tracks, axis=0), axis=2).sum(0).mean())


def _degraded(
    room: Room,
    lens: Lens,
    middle: NDArray[np.float64],
    depth: NDArray[np.float64],
    fault: Degradation,
    rng: np.random.Generator,
) -> tuple[NDArray[np.float64], float, float]:
    """One frame as the camera records it (linear light, before noise), its blur length and disc radius."""
    scale = lens.width / REFERENCE_WIDTH
    blur, radius = fault.blur * scale, fault.defocus * scale
    # Enough passes that neighbouring ghosts of an edge lie less than a pixel apart.
    count = max(SHARP_PASSES, math.ceil(1.5 * blur), math.ceil(4 * radius**2))
    instants = (np.arange(count) + 0.5) / count - 0.5
    poses = exposure_poses(middle, instants, blur / lens.focal, rng)
    mean_nearness = float(np.mean(1 / depth))
    aperture = radius * 1.5 / (lens.focal * abs(1 / NEAR_FOCUS - mean_nearness))
    rows = np.broadcast_to(poses[:, None], (count, lens.height, 3, 4)).copy()
    lens_points = _disc(count, aperture)[rng.permutation(count)]
    passes = Passes(rows, _low_discrepancy(count), lens_points, NEAR_FOCUS if radius else 1.0)
    image, _ = cast(room, passes, lens.intrinsics, lens.width, lens.height)
    # The mean radius of a uniform disc's points is 2/3 of its rim: `defocus` states the mean.
    return image * 2.0**fault.exposure, _blur_length(lens, depth, poses, middle), radius


def _record(image: NDArray[np.float64], noise: float, rng: np.random.Generator) -> NDArray[np.uint8]:
    """Sensor noise, clipping, sRGB encoding, 8 bits: RGB [H, W, 3]."""
    mid_grey_slope = 0.6  # d linear / d sRGB at mid grey: carries the stated deviation into linear light
    shot = np.sqrt(np.clip(image, 0, None) / 0.2 * 0.7 + 0.3)
    noisy = image + rng.standard_normal(image.shape) * noise * mid_grey_slope * shot
    return np.asarray(np.rint(srgb_from_linear(np.clip(noisy, 0, 1)) * 255), np.uint8)


def _write_image(path: Path, image: NDArray[np.uint8]) -> None:
    with atomic_path(path) as temporary:
        cv2.imwrite(str(temporary), image[..., ::-1])


def _write_transforms(folder: Path, lens: Lens, images: list[str], poses: list[NDArray[np.float64]]) -> None:
    """``transforms.json`` as nerfstudio reads it: OpenGL camera to world."""
    fx, fy, cx, cy = lens.intrinsics
    frames = []
    for image, pose in zip(images, poses, strict=True):
        matrix = np.vstack([pose, [0, 0, 0, 1]]) @ np.diag([1.0, -1.0, -1.0, 1.0])
        frames.append({"file_path": image, "transform_matrix": matrix.tolist()})
    camera = {"camera_model": "OPENCV", "fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy}
    write_json(folder / "transforms.json", {**camera, "w": lens.width, "h": lens.height, "frames": frames})


def _novel_poses(path: HandheldPath, count: int, seed: int) -> list[NDArray[np.float64]]:
    """Poses off the path: nearer or farther, higher or lower, aimed at the same spot."""
    rng = np.random.default_rng([seed, 14])
    poses = []
    for share in (np.arange(count) + 0.5) / count:
        centre = path.pose(share * path.duration)[:, 3] + rng.uniform(-0.22, 0.22, 3)
        poses.append(look_at(centre, path.focus + rng.uniform(-0.08, 0.08, 3)))
    return poses


def make_capture(
    out: Path, protocol: str, *, frames: int, width: int, height: int, seed: int, reporter: Reporter
) -> None:
    """Write the capture ``protocol`` of the room of ``seed`` into ``out``.

    ``out/images`` and ``out/transforms.json`` are what a user would have; ``out/truth/observed`` and
    ``out/truth/novel`` hold sharp views in the same form (at the frames' mid-exposure poses and off the path)
    and ``out/truth/frames.parquet`` each frame's faults (`TRUTH_SCHEMA`). Images are 8-bit sRGB PNGs.

    Raises InputError for an unknown protocol or a folder that already holds something.
    """
    faults = degradations(protocol, frames, seed)
    if out.exists() and any(out.iterdir()):
        raise InputError(f"{out} is not empty", hint="name a new folder for the capture")
    room, lens = make_room(seed), Lens(width, height)
    path = make_path(room.focus, frames, seed)
    times = (np.arange(frames) + 0.5) / frames * path.duration
    poses = [path.pose(float(time)) for time in times]
    names = [f"images/{number:06d}.png" for number in range(frames)]
    observed, novel = out / "truth" / "observed", out / "truth" / "novel"
    for folder in (out, observed, novel):
        (folder / "images").mkdir(parents=True, exist_ok=True)

    rows = []
    novel_poses = _novel_poses(path, max(4, frames // 4), seed)
    with reporter.task(f"ray casting {protocol}", frames + len(novel_poses)) as task:
        for number, (pose, fault) in enumerate(zip(poses, faults, strict=True)):
            rng = np.random.default_rng([seed, 15, number])
            sharp, depth = _sharp(room, lens, pose)
            image, blur, radius = _degraded(room, lens, pose, depth, fault, rng)
            _write_image(observed / names[number], _record(sharp, 0.0, rng))
            _write_image(out / names[number], _record(image, fault.noise, rng))
            rows.append(
                {
                    "frame_id": number,
                    "image": names[number],
                    "time_s": float(times[number]),
                    "blur_px": blur,
                    "defocus_px": radius,
                    "exposure_ev": fault.exposure,
                    "noise": fault.noise,
                }
            )
            task.advance()
        novel_names = [f"images/{number:06d}.png" for number in range(len(novel_poses))]
        for name, pose in zip(novel_names, novel_poses, strict=True):
            _write_image(novel / name, _record(_sharp(room, lens, pose)[0], 0.0, rng))
            task.advance()
    write_table(out / "truth" / "frames.parquet", pa.Table.from_pylist(rows), TRUTH_SCHEMA)
    _write_transforms(observed, lens, names, poses)
    _write_transforms(novel, lens, novel_names, novel_poses)
    _write_transforms(out, lens, names, poses)
