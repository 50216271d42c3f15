"""Write the scene of a run for other programs."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from cleargs.capture.cameras import Similarity, upright
from cleargs.capture.tables import load_frames
from cleargs.errors import InputError
from cleargs.files import disk_errors, write_json
from cleargs.named_views import read_views
from cleargs.pipeline.outputs import check_outputs
from cleargs.pipeline.stages import installed
from cleargs.progress import Reporter
from cleargs.render.pruning import crop_scene, drop_spheres, parse_crop, parse_drop, parse_prune, prune_scene
from cleargs.render.sidecars import stem, views_json, write_sidecars
from cleargs.run_results import edited_scene, scene_origin, scene_path
from cleargs.scene.views import camera_of
from cleargs.splat.camera import Camera
from cleargs.splat.formats import check_up, format_of, padded, read_scene, write_scene
from cleargs.splat.ply import read_ply
from cleargs.splat.scene import Scene
from cleargs.splat.spz import SpzVersion
from cleargs.splat.transforms import UP, far_offset, orient_up, transform_scene


@dataclass(frozen=True)
class ExportOptions:
    """Choices of `export_scene`; see ``cleargs export --help``."""

    up: str | None = None
    upright: str | None = None
    """``FRAME:SIDE`` or ``X,Y,Z``: the side of a picture, or the direction in the run's world, that is up."""
    world: Literal["normalised", "input"] = "normalised"
    metres: str | None = None
    """``A-B=D``: the cameras of frames A and B are D metres apart."""
    sh_degree: int | None = None
    prune: Sequence[str] = ()
    crop: str | None = None
    drop: Sequence[str] = ()
    cameras: bool = False
    """Write cameras and COLMAP model too."""
    force: bool = False
    """Replace existing files."""
    spz: SpzVersion = 3
    """Version of .spz files."""
    views: bool = False
    """Write the named views of the run, if it has some, next to the first file."""
    scene: Path | None = None
    """An edited copy of the run's scene, in its place."""


def export_scene(
    run: Path, stage: str, outputs: Sequence[Path], options: ExportOptions, reporter: Reporter
) -> list[str]:
    """Write the scene of ``stage`` to each of the ``outputs``. Return messages about the result.

    Raises InputError if an option cannot be used, or if a file exists and is not to be replaced.
    """
    kinds = _kinds(outputs, options)
    if (options.up or options.upright) is not None and options.world == "input":
        raise InputError("--up and --upright exclude --world input", hint="give one of them")
    thresholds = parse_prune(options.prune)
    edited = () if options.scene is None else (options.scene,)
    check_outputs(outputs, installed(), run, inputs=edited, force=options.force)
    ingest = run / "ingest"
    posed = [frame for frame in load_frames(ingest) if frame.registered]
    cameras = {frame.frame_id: (frame.name, camera_of(frame)) for frame in posed}
    similarity = _similarity(ingest, cameras, options)
    scene, messages = read_ply(scene_path(run, stage)), list[str]()
    if options.scene is not None:
        scene = edited_scene(run, stage, options.scene)
    if thresholds:
        scene, message = prune_scene(scene, thresholds, run, stage, reporter)
        messages.append(message)
    if options.sh_degree is not None:
        scene = padded(scene, options.sh_degree)
    if options.world == "input" and (offset := far_offset(scene.gaussians, similarity)):
        similarity["translation"] = similarity["translation"] - np.array(offset)
        file = outputs[0].with_name(f"{stem(outputs[0])}.offset.json")
        check_outputs([file], installed(), run, force=options.force)
        write_json(file, {"definition": "x_input = x_file + offset", "offset": offset})
        messages.append(
            "single precision would round positions so far from the origin: the files are written without "
            f"the offset {offset}, which is in {file}"
        )
    if similarity:
        scene = transform_scene(scene, **similarity)
    scene, cropped = _cropped(scene, options)
    for output in outputs if options.cameras else ():
        write_sidecars(output, ingest, list(cameras.values()), similarity, force=options.force)
    if options.views and (views := read_views(run)):
        file = outputs[0].with_name(f"{stem(outputs[0])}.views.json")
        check_outputs([file], installed(), run, force=options.force)
        write_json(file, views_json(views, next(iter(cameras.values()))[1], **similarity))
        messages.append(f"{file}: {len(views)} views")
    up = options.up or ("-y" if options.upright is not None else None)
    axes = f"{options.world} world" if up is None else f"{up} is up"
    if options.metres is not None:
        axes += f", in metres (a unit of the run is {similarity['scale']:.4g} m)"
    eyes = np.stack([camera.centre for _, camera in cameras.values()])
    if similarity:
        eyes = similarity["scale"] * eyes @ similarity["rotation"].T + similarity["translation"]
    files = dict(zip(outputs, kinds, strict=True))
    origin = scene_origin(installed(), run, stage)
    source = f"scene of {origin}" if options.scene is None else str(options.scene)
    written = _write(scene, files, options, f"{source}, {axes}", eyes)
    return [*messages, *cropped, *written]


def export_file(file: Path, outputs: Sequence[Path], options: ExportOptions) -> list[str]:
    """Write the scene file of any program to each of the ``outputs``. Return messages about the result.

    Raises InputError for options that need a run, and StoreError if the file cannot be read.
    """
    kinds = _kinds(outputs, options)
    if options.world == "input" or options.metres or options.prune or options.cameras or options.scene:
        raise InputError(
            "--world, --metres, --prune, --cameras and --scene need the cameras of a run",
            hint="leave them out for a file",
        )
    check_outputs(outputs, installed(), inputs=[file], force=options.force)
    scene = read_scene(file)
    if options.sh_degree is not None:
        scene = padded(scene, options.sh_degree)
    if (options.up or options.upright) is not None:
        rotation = np.array(UP[options.up or "-y"])
        if options.upright is not None:
            rotation = rotation @ upright(_direction(options.upright, {}))
        scene = transform_scene(scene, scale=1.0, rotation=rotation, translation=np.zeros(3))
    scene, cropped = _cropped(scene, options)
    written = _write(scene, dict(zip(outputs, kinds, strict=True)), options, f"scene of {file.name}")
    return [*cropped, *written]


_SIDES = {"top": (1, -1.0), "bottom": (1, 1.0), "left": (0, -1.0), "right": (0, 1.0)}
"""Side of a picture -> axis of its camera, and sign."""


def _direction(text: str, cameras: Mapping[int, tuple[str, Camera]]) -> NDArray[np.float64]:  # [3]
    """Return the direction in the run's world that ``--upright`` gives. Raises InputError."""
    side = re.fullmatch(r"(\d+):(top|bottom|left|right)", text)
    if side is not None and int(side[1]) in cameras:
        axis, sign = _SIDES[side[2]]
        return np.asarray(sign * cameras[int(side[1])][1].world_to_camera[axis, :3])
    with suppress(ValueError):
        direction = np.array([float(number) for number in text.split(",")])
        if direction.shape == (3,) and np.isfinite(direction).all() and np.linalg.norm(direction) > 1e-6:
            return direction
    frames = f"; frames with a pose are {min(cameras)} to {max(cameras)}" if cameras else ""
    raise InputError(
        f"--upright {text} cannot be used",
        hint=f"give FRAME:top, left, right or bottom, or a direction X,Y,Z{frames}",
    )


def _kinds(outputs: Sequence[Path], options: ExportOptions) -> list[str]:
    """Return the formats of the ``outputs``. Raises InputError if one cannot be written so."""
    kinds = [format_of(output) for output in outputs]
    for kind in kinds:
        check_up(kind, options.up)
    parse_crop(options.crop)
    parse_drop(options.drop)
    return kinds


def _cropped(scene: Scene, options: ExportOptions) -> tuple[Scene, list[str]]:
    """Return the scene in the box of the options, and messages. Raises InputError if nothing is left.

    Boxes and spheres are in the coordinates of the file.
    """
    scene, messages = drop_spheres(scene, parse_drop(options.drop))
    if (region := parse_crop(options.crop)) is not None:
        scene, message = crop_scene(scene, region)
        messages.append(message)
    if scene.gaussians.num == 0:
        raise InputError("no Gaussian is left", hint="prune or crop less")
    return scene, messages


def _write(
    scene: Scene,
    outputs: Mapping[Path, str],
    options: ExportOptions,
    subject: str,
    eyes: NDArray[np.float64] | None = None,
) -> list[str]:
    """Write a scene to each of the ``outputs`` (file -> format), for the camera centres ``eyes`` [M, 3].

    Return messages.
    """
    messages = []
    if "ply" in outputs.values() and 0 < (degree := scene.gaussians.sh_degree) < 3:
        messages.append(
            f"spherical harmonics of degree {degree}; for a viewer that reads only degree 3: --sh-degree 3"
        )
    for output, kind in outputs.items():
        with disk_errors(output):
            output.parent.mkdir(parents=True, exist_ok=True)
        turned = options.up is not None
        messages += write_scene(output, scene, kind, turned=turned, spz_version=options.spz, eyes=eyes)
        messages.append(f"{output}: {subject}, {scene.gaussians.num} Gaussians")
    return messages


def _similarity(
    ingest: Path, cameras: Mapping[int, tuple[str, Camera]], options: ExportOptions
) -> dict[str, Any]:
    """Return the similarity from the world of the run to that of the files; {} for the identity."""
    similarity: dict[str, Any] = {}
    if options.world == "input":
        world = Similarity.read(ingest)
        similarity = {"scale": world.scale, "rotation": world.rotation.T, "translation": world.origin}
    else:
        stand = np.eye(3) if options.upright is None else upright(_direction(options.upright, cameras))
        if options.up is not None:
            first = next(iter(cameras.values()))[1]
            pose = first.world_to_camera.copy()
            pose[:3, :3] = pose[:3, :3] @ stand.T
            similarity = orient_up(replace(first, world_to_camera=pose), options.up)
            similarity["rotation"] = similarity["rotation"] @ stand
        elif options.upright is not None:
            similarity = {"scale": 1.0, "rotation": stand, "translation": np.zeros(3)}
    if options.metres is not None:
        match = re.fullmatch(r"(\d+)-(\d+)=(\d*\.?\d+)", options.metres)
        pair = [int(match[n]) for n in (1, 2)] if match else []
        wanted = float(match[3]) if match else 0.0
        if not wanted or not set(pair) <= cameras.keys():
            raise InputError(
                f"--metres {options.metres} cannot be used",
                hint=f"give FRAME-FRAME=METRES; frames with a pose are {min(cameras)} to {max(cameras)}",
            )
        similarity = similarity or {"scale": 1.0, "rotation": np.eye(3), "translation": np.zeros(3)}
        apart = float(np.linalg.norm(cameras[pair[0]][1].centre - cameras[pair[1]][1].centre))
        if apart == 0.0:
            raise InputError("the two frames of --metres have the same place", hint="choose other frames")
        factor = wanted / (apart * similarity["scale"])
        similarity |= {name: factor * similarity[name] for name in ("scale", "translation")}
    return similarity
