"""What is written of a scene: a still, a folder of stills, or a film. Pictures are made one by one."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import cv2
import numpy as np

from cleargs.errors import InputError
from cleargs.files import disk_errors, sync_tree, whole_folder, write_json
from cleargs.media.encode import Codec, require_even, write_video
from cleargs.media.exr import write_view
from cleargs.media.image import read_rgb, write_rgb
from cleargs.progress import Task
from cleargs.splat.camera import Camera, cameras_json
from cleargs.splat.render import Viewer
from cleargs.splat.scene import Scene
from cleargs.types import ImageU8

Kind = Literal["film", "still", "folder"]

_NUMBER = re.compile(r"%0?\d*d")
_OPAQUE = 1 / 255
"""Alpha from which a pixel has a depth."""


@dataclass(frozen=True)
class Shot:
    """One picture to make."""

    camera: Camera
    filmed: Path | None = None
    """The frame of the capture to lay on its left."""


class ShotRenderer(Viewer):
    """Renders shots of one scene."""

    def picture(self, shot: Shot) -> ImageU8:
        """What ``shot`` shows; of twice the width where it has a frame of the capture beside it."""
        rendered = self.view(shot.camera)
        if shot.filmed is None:
            return rendered
        return np.concatenate([_fitted(read_rgb(shot.filmed), *rendered.shape[:2]), rendered], axis=1)

    def write(self, path: Path, shot: Shot) -> None:
        """Write a still: a PNG of `picture`, or an EXR of the view over black.

        The EXR has alpha, and the mean depth along the optical axis in world units, 0 where nothing is seen.
        """
        if path.suffix.lower() != ".exr":
            write_rgb(path, self.picture(shot))
            return
        render = self.render(shot.camera, (0.0, 0.0, 0.0), depth=True)
        assert render.depth is not None
        image, alpha, depth = (layer.cpu().numpy() for layer in (render.image, render.alpha, render.depth))
        depth = np.where(alpha >= _OPAQUE, depth / np.maximum(alpha, _OPAQUE), 0.0).astype(np.float32)
        write_view(path, image, alpha, depth)


def kind_of(output: Path) -> Kind:
    """What the name of ``output`` asks for: FILE.mp4, FILE.png or .exr, FOLDER/%04d.png or .exr.

    Raises InputError for any other.
    """
    suffix, numbers = output.suffix.lower(), len(_NUMBER.findall(output.name))
    if suffix == ".mp4" and not numbers:
        return "film"
    if suffix in (".png", ".exr") and numbers < 2:
        return "folder" if numbers else "still"
    raise InputError(
        f"{output} has no ending that says what to write",
        hint="end it with .mp4 (a film), .png or .exr (a still); FOLDER/%04d.png numbers stills",
    )


def require_free(output: Path, *, force: bool) -> None:
    """Raise InputError when something is at ``output`` already that ``force`` does not replace.

    A folder is never replaced: there may be more in it than our stills.
    """
    if kind_of(output) == "folder":
        if output.parent.exists():
            raise InputError(f"{output.parent} exists already", hint="choose a folder that is not there yet")
    elif output.exists() and not force:
        raise InputError(f"{output} exists already", hint="choose another name, or give --force")


def write_shots(
    output: Path, scene: Scene, shots: Sequence[Shot], task: Task, *, fps: float, codec: Codec, device: str
) -> None:
    """Write ``shots`` (of one size) to ``output``, which appears whole or not at all.

    Beside the stills of a folder lies their ``cameras.json``. Raises InputError when ``output`` cannot hold
    them, StoreError when the disk is full or not writable.
    """
    kind, camera = kind_of(output), shots[0].camera
    if kind == "still" and len(shots) > 1:
        raise InputError(
            f"{len(shots)} pictures do not fit into {output.name}",
            hint=f"number them (FOLDER/%04d{output.suffix}), or write a film (.mp4)",
        )
    if kind == "film":
        require_even(camera.width, camera.height)
    renderer = ShotRenderer(scene, device)
    with disk_errors(output):
        (output.parent.parent if kind == "folder" else output.parent).mkdir(parents=True, exist_ok=True)

    def pictures() -> Iterator[ImageU8]:
        for shot in shots:
            yield renderer.picture(shot)
            task.advance()

    if kind == "film":
        write_video(output, pictures(), fps, codec=codec)
    elif kind == "still":
        renderer.write(output, shots[0])
        task.advance()
    else:
        (before, after), (digits,) = _NUMBER.split(output.name), _NUMBER.findall(output.name)
        names = [f"{before}{digits % number}{after}" for number in range(len(shots))]
        with whole_folder(output.parent) as folder:
            for name, shot in zip(names, shots, strict=True):
                renderer.write(folder / name, shot)
                task.advance()
            cameras = cameras_json(list(zip(names, (shot.camera for shot in shots), strict=True)))
            write_json(folder / "cameras.json", cameras)
            sync_tree(folder)


def _fitted(image: ImageU8, height: int, width: int) -> ImageU8:
    """``image`` at the place that `cleargs.render.paths.framed` gives its content, black around it."""
    scale = min(width / image.shape[1], height / image.shape[0])
    wide, high = max(1, round(image.shape[1] * scale)), max(1, round(image.shape[0] * scale))
    way = cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC
    small = cv2.resize(image, (wide, high), interpolation=way)
    left, top = (width - wide) // 2, (height - high) // 2
    borders = (top, height - high - top, left, width - wide - left)
    return np.asarray(cv2.copyMakeBorder(small, *borders, cv2.BORDER_CONSTANT), np.uint8)
