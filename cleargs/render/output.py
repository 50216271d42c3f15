"""Output of renders: a still, a folder of stills, or a film. Images are rendered one by one."""

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
_OPAQUE = 1 / 255  # alpha from which a pixel has a depth: one level of an 8-bit image


@dataclass(frozen=True)
class Shot:
    """One image to render."""

    camera: Camera
    filmed: Path | None = None
    """Frame image to show on the left of the render."""


class ShotRenderer(Viewer):
    """Renders shots of one scene."""

    def picture(self, shot: Shot) -> ImageU8:
        """Render ``shot``. The image is twice as wide if the shot has a frame image, which is on the left."""
        rendered = self.view(shot.camera)
        if shot.filmed is None:
            return rendered
        return np.concatenate([_fitted(read_rgb(shot.filmed), *rendered.shape[:2]), rendered], axis=1)

    def write(self, path: Path, shot: Shot) -> None:
        """Write a still: a PNG of `picture`, or an EXR of the render over black.

        The EXR also has alpha, and the mean camera z in world units (0 for transparent pixels) as depth.
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
    """Return the kind of output for a file name: film (.mp4), still (.png, .exr) or folder (FOLDER/%04d.png).

    Raises InputError for any other name.
    """
    suffix, numbers = output.suffix.lower(), len(_NUMBER.findall(output.name))
    if suffix == ".mp4" and not numbers:
        return "film"
    if suffix in (".png", ".exr") and numbers < 2:
        return "folder" if numbers else "still"
    raise InputError(
        f"{output} has no ending of a film or a still",
        hint="end it with .mp4 (a film), .png or .exr (a still), or write numbered stills to FOLDER/%04d.png",
    )


def write_shots(
    output: Path, scene: Scene, shots: Sequence[Shot], task: Task, *, fps: float, codec: Codec, device: str
) -> None:
    """Render shots of one size and write them to ``output`` (see `kind_of`), atomically.

    A folder of stills also gets ``cameras.json``. ``task`` receives one step per shot. ``fps`` and ``codec``
    are those of a film. Raises InputError if there are several shots for one still, or if the size does not
    fit the codec, and StoreError if the disk is full or not writable.
    """
    kind, camera = kind_of(output), shots[0].camera
    if kind == "still" and len(shots) > 1:
        raise InputError(
            f"{output.name} can store only one image, not {len(shots)}",
            hint=f"write numbered stills (FOLDER/%04d{output.suffix}) or a film (.mp4)",
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
    """Scale ``image`` to fit, with black borders, so that it matches `cleargs.render.paths.framed`."""
    scale = min(width / image.shape[1], height / image.shape[0])
    wide, high = max(1, round(image.shape[1] * scale)), max(1, round(image.shape[0] * scale))
    interpolation = cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC
    small = cv2.resize(image, (wide, high), interpolation=interpolation)
    left, top = (width - wide) // 2, (height - high) // 2
    borders = (top, height - high - top, left, width - wide - left)
    return np.asarray(cv2.copyMakeBorder(small, *borders, cv2.BORDER_CONSTANT), np.uint8)
