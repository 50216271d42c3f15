"""Shots of a run: a still, its camera path, a turntable, or the poses in a file."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from cleargs.capture.cameras import Pose, Similarity, rigid_pose
from cleargs.capture.summary import IngestSummary
from cleargs.capture.tables import Frame, load_frames
from cleargs.errors import InputError
from cleargs.manifest import linked_manifest
from cleargs.media import MAX_PIXELS
from cleargs.media.encode import Codec
from cleargs.packed import require_images
from cleargs.pipeline.outputs import check_outputs
from cleargs.pipeline.stages import installed
from cleargs.progress import Reporter
from cleargs.render.output import Kind, Shot, kind_of, write_shots
from cleargs.render.paths import framed, smooth_path, turntable
from cleargs.run_results import edited_scene, scene_path
from cleargs.safe_io import FAULTS, cause, read_json
from cleargs.scene.views import camera_of
from cleargs.splat.camera import Camera
from cleargs.splat.formats import read_scene

World = Literal["normalised", "input"]

_OPENGL = np.array([1.0, -1.0, -1.0])
"""Factors that turn the axes of an OpenCV camera into those of an OpenGL camera, and back."""
_HINT = "give cameras.json as `cleargs export` writes it, or transforms.json as nerfstudio does"

_NERFSTUDIO = {"w": "width", "h": "height", "fl_x": "fx", "fl_y": "fy", "cx": "cx", "cy": "cy"}
"""Field of transforms.json -> field of a camera."""

Size = tuple[int, int]

_LENS = Camera(1280, 720, 960.0, 960.0, 640.0, 360.0, np.eye(4))
"""Lens of the poses of a scene file, if they name none: 67 degrees wide."""

SECONDS = 10.0
"""Default length of a film."""


@dataclass(frozen=True)
class ShotOptions:
    """The pictures to render. Without ``frame``, ``turntable`` and ``poses``, they follow the camera path."""

    frame: int | None = None
    """Render a still at the pose of this frame."""
    turntable: bool = False
    poses: Path | None = None
    """Render a picture at each pose in this file."""
    world: World | None = None
    """World of `poses`."""
    size: Size | None = None
    """Width and height, px."""
    scene: Path | None = None
    """An edited copy of the run's scene, in its place."""
    fps: float = 30.0
    seconds: float | None = None
    side_by_side: bool = False
    codec: Codec = "h264"

    def check(self, output: Path) -> None:
        """Raise InputError if the options contradict each other, or ``output``."""
        ending, still, posed = output.suffix.lower(), self.frame is not None, self.poses is not None
        for wrong, message, hint in (
            (still + self.turntable + posed > 1, "two of --frame, --turntable, --poses", "give one of them"),
            (still and ending == ".mp4", "--frame is a still", "end --output with .png or .exr"),
            (self.world and not posed, "--world needs --poses", "give --poses, or omit --world"),
            (
                self.seconds is not None and (posed or still),
                "--seconds is the length of the path or the turntable",
                "omit it; --fps sets the speed of --poses",
            ),
            (
                self.side_by_side and (self.turntable or posed),
                "--side-by-side needs frames of the capture",
                "omit --turntable and --poses to follow the path, or give --frame",
            ),
            (self.side_by_side and ending == ".exr", "--side-by-side is for films and PNGs", "omit it"),
        ):
            if wrong:
                raise InputError(message, hint=hint)


def render_run(
    run: Path,
    stage: str,
    output: Path,
    options: ShotOptions,
    reporter: Reporter,
    *,
    force: bool = False,
    device: str = "cpu",
) -> list[Shot]:
    """Render the scene of a stage of ``run`` to ``output``. Return the shots.

    A scene file without a run is rendered at the poses of the options, which are in its own world. Raises
    InputError if an option cannot be used, or if ``output`` exists and is not to be replaced.
    """
    options.check(output)
    kind = kind_of(output)
    if kind == "folder" and output.parent.exists():  # it may contain other files than stills
        raise InputError(f"{output.parent} exists already", hint="choose a new folder")
    inputs = [path for path in (options.poses, options.scene) if path is not None]
    if run.is_file():
        if options.scene is not None:
            raise InputError("--scene is an edited scene of a run", hint="give the run, or leave out --scene")
        check_outputs([output], installed(), inputs=(run, *inputs), force=force)
        if options.poses is None:
            raise InputError(f"{run} has no cameras", hint="give --poses FILE.json, or a run")
        own = Similarity(np.eye(3), np.zeros(3), 1.0)
        shots = _framed(read_poses(options.poses, _LENS, own, "normalised"), options, kind)
        file = run
    else:
        check_outputs([output], installed(), run, inputs=inputs, force=force)
        if options.side_by_side:
            require_images(run, "--side-by-side")
        shots, file = _shots(run / "ingest", options, kind), scene_path(run, stage)
        if options.poses is not None and not _has_given_world(run) and _world_of(options) == "input":
            reporter.warn(
                f"poses of another program do not fit: ClearGS found those of {run} itself, in its own world"
            )
    with reporter.task(f"rendering {output.name}", total=len(shots)) as task:
        scene = read_scene(file) if options.scene is None else edited_scene(run, stage, options.scene)
        write_shots(output, scene, shots, task, fps=options.fps, codec=options.codec, device=device)
    return shots


def _shots(ingest: Path, options: ShotOptions, kind: Kind) -> list[Shot]:
    """Return the shots of the prepared capture ``ingest``, all of one size.

    Without a size in ``options``, it is that of the first camera; a film gets one pixel more per odd side.
    Raises InputError if no frame has a pose.
    """
    listed = load_frames(ingest)
    frames = [frame for frame in listed if frame.registered]
    if not frames:
        raise InputError("no frame of this capture has a pose", hint="see cleargs show RUN ingest")
    own = [camera_of(frame) for frame in frames]
    lens = own[len(own) // 2]
    count = max(2, round(options.fps * (options.seconds or SECONDS)))
    filmed: list[Frame] = []
    if options.poses is not None:
        cameras = read_poses(options.poses, lens, Similarity.read(ingest), options.world)
    elif options.turntable:
        cameras = [replace(lens, world_to_camera=pose) for pose in turntable(own, count)]
    elif options.frame is not None or kind == "still":
        numbers = [frame.frame_id for frame in frames]
        number = numbers[len(numbers) // 2] if options.frame is None else options.frame
        if number not in numbers:
            exists = any(frame.frame_id == number for frame in listed)
            raise InputError(
                f"frame {number} {'has no pose' if exists else 'is not in this capture'}",
                hint=f"choose one from {numbers[0]} to {numbers[-1]}",
            )
        index = numbers.index(number)
        cameras, filmed = [own[index]], [frames[index]]
    else:
        poses, nearest = smooth_path(own, count)
        cameras = [replace(lens, world_to_camera=pose) for pose in poses]
        filmed = [frames[index] for index in nearest]
    images = [ingest / frame.image for frame in filmed] if options.side_by_side else None
    return _framed(cameras, options, kind, images)


def _has_given_world(run: Path) -> bool:
    """Return False if the poses of ``run`` were found without poses of the input."""
    found = IngestSummary.of(linked_manifest(run, "ingest"))
    return found.poses != "sfm" or bool(found.kept_out_matches_off_px)


def _world_of(options: ShotOptions) -> World:
    """Return the world of the poses: that of the options, or the usual one of their file."""
    assert options.poses is not None
    usual: World = "normalised" if isinstance(read_json(options.poses), list) else "input"
    return options.world or usual


def _framed(
    cameras: Sequence[Camera], options: ShotOptions, kind: Kind, images: Sequence[Path | None] | None = None
) -> list[Shot]:
    """Return shots of one size, with the ``images`` next to them."""
    width, height = options.size or (cameras[0].width, cameras[0].height)
    if options.size is None and kind == "film":
        width, height = width + width % 2, height + height % 2
    if width * height > MAX_PIXELS:
        raise InputError(f"an image of {width}x{height} pixels is too large", hint="give a smaller --size")
    beside: Sequence[Path | None] = images or [None] * len(cameras)
    return [Shot(framed(camera, width, height), image) for camera, image in zip(cameras, beside, strict=True)]


def read_poses(path: Path, lens: Camera, similarity: Similarity, world: World | None = None) -> list[Camera]:
    """Read the cameras of a ``cameras.json`` or ``transforms.json``, in normalised coordinates.

    ``lens`` gives the size and intrinsics that the file lacks; distortion is ignored. ``similarity`` maps
    input coordinates to normalised ones. ``world`` is that of the file (default: normalised for cameras.json,
    input for transforms.json). Raises InputError if the file has another form, or a pose is not rigid.
    """
    try:
        document = read_json(path)
        usual: World = "normalised" if isinstance(document, list) else "input"
        if isinstance(document, list):
            listed = [_of_cameras_json(entry, lens, f"camera {n}") for n, entry in enumerate(document)]
        else:
            frames = document.pop("frames")
            listed = [
                _of_transforms({**document, **entry}, lens, f"frame {n}") for n, entry in enumerate(frames)
            ]
        if not listed:
            raise ValueError("it has no poses")
    except InputError as error:
        raise InputError(f"{path}: {error}", hint=error.hint) from error
    except FAULTS as error:
        raise InputError(f"cannot read {path}: {cause(error)}", hint=_HINT) from error
    cameras = []
    for camera, pose in listed:
        placed = pose if (world or usual) == "normalised" else similarity.pose(pose)
        matrix = np.vstack([np.column_stack([placed.rotation, placed.translation]), [0.0, 0.0, 0.0, 1.0]])
        cameras.append(replace(camera, world_to_camera=matrix))
    return cameras


def _of_cameras_json(entry: Mapping[str, Any], lens: Camera, name: str) -> tuple[Camera, Pose]:
    """Read an entry in the layout of the Inria code: position and axes of the camera in the world."""
    axes = np.array(entry["rotation"], np.float64).reshape(3, 3) * _OPENGL
    matrix = np.column_stack([axes, np.array(entry["position"], np.float64).reshape(3)])
    return _with_lens(lens, entry), rigid_pose(matrix, name, _HINT)


def _of_transforms(entry: Mapping[str, Any], lens: Camera, name: str) -> tuple[Camera, Pose]:
    """Read an entry of nerfstudio: an OpenGL camera-to-world matrix, and intrinsics if it has any."""
    matrix = np.array(entry["transform_matrix"], np.float64)
    if matrix.shape not in ((4, 4), (3, 4)):
        raise ValueError(f"the transform_matrix of {name} is not 4x4")
    values = {ours: entry[theirs] for theirs, ours in _NERFSTUDIO.items() if theirs in entry}
    if "camera_angle_x" in entry and "fx" not in values:
        half = math.tan(0.5 * float(entry["camera_angle_x"]))
        values["fx"] = 0.5 * float(values.get("width", lens.width)) / half
    return _with_lens(lens, values), rigid_pose(matrix, name, _HINT)


def _with_lens(lens: Camera, entry: Mapping[str, Any]) -> Camera:
    """Return ``lens`` with the size, focal lengths and principal point of ``entry``, if they are given."""
    scaled = lens.resized(int(entry.get("width", lens.width)), int(entry.get("height", lens.height)))
    numbers: dict[str, Any] = {name: float(entry[name]) for name in ("fx", "fy", "cx", "cy") if name in entry}
    if "fx" in numbers:
        numbers.setdefault("fy", numbers["fx"])
    return replace(scaled, **numbers)
