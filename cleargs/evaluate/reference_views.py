"""The images that a scene is compared with, their cameras and masks."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import TypeVar

import numpy as np

from cleargs.capture.cameras import Intrinsics as Lens
from cleargs.capture.cameras import Pose
from cleargs.capture.capture import SourceFrame
from cleargs.capture.cutouts import are_cut_outs, over_white
from cleargs.capture.folders import chosen, name_below_images
from cleargs.capture.layouts.transforms import read_transforms
from cleargs.capture.prepare import is_as_stored, read_image, read_source_mask
from cleargs.capture.undistort import Undistorter, undistorter
from cleargs.errors import InputError
from cleargs.formation.measured import MeasuredPath
from cleargs.media import IMAGE_SUFFIXES
from cleargs.media.image import read_transparency
from cleargs.models.tiling import MIN_SIDE
from cleargs.splat.camera import Camera
from cleargs.splat.views import TrainingView
from cleargs.types import ImageU8, MaskBool

T = TypeVar("T")


@dataclass(frozen=True, eq=False)
class ReferenceView:
    """One image to compare with."""

    name: str
    """Stem of its file, by which it is matched."""
    camera: Camera
    """Pinhole of the image, in the scene's world."""
    load: Callable[[], tuple[ImageU8, MaskBool | None]]
    """Returns the image [H, W, 3] and its mask [H, W] (True counts; None: all do). Raises InputError."""
    depth: Path | None = None
    """EXR of the true depth, as `cleargs synth` writes it; None if it is not known."""
    unit: float = 1.0
    """Length of a unit of the scene, in the units of ``depth``."""
    path: MeasuredPath | None = None
    """Measured motion of the camera; None if none is known."""
    cut_out: bool = False
    """True if the image is a cut-out over white: renders are compared over white, empty pixels count."""

    @property
    def pose(self) -> Pose:
        """Pose of the camera in the scene's world."""
        return Pose(self.camera.world_to_camera[:3, :3], self.camera.world_to_camera[:3, 3])

    def at(self, pose: Pose) -> ReferenceView:
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = pose.rotation, pose.translation
        return replace(self, camera=replace(self.camera, world_to_camera=matrix))


def listed_views(directory: Path) -> dict[str, ReferenceView]:
    """Return the views of a folder with ``transforms.json``, by stem, in the folder's world."""
    path = directory / "transforms.json"
    if not path.is_file():
        raise InputError(
            f"{directory} is not a reference: it has no transforms.json",
            hint="give a folder with images/ and transforms.json in the world of the run's input",
        )
    entries = read_transforms(path, poses=True)
    if not entries:
        raise InputError(f"{path} lists no frames", hint="list at least one image with its pose")
    names = [name_below_images(entry.name) for entry in entries]
    way_of = cache(partial(undistorter, max_size=sys.maxsize))
    views, found = [], chosen(entries, directory / "images", len(entries), names)
    cut_out = are_cut_outs([entry.path for entry in found])
    for entry in found:
        lens, pose = entry.camera, entry.pose
        assert lens is not None and pose is not None  # asked for with poses=True
        way = way_of(lens)
        flat = way.pinhole
        camera = Camera(flat.width, flat.height, *flat.focal, *flat.centre, np.eye(4))
        stem = stem_of(entry.name)
        depth = directory / "depth" / f"{stem}.exr"
        known = depth if lens.is_pinhole and depth.is_file() else None
        load = partial(loaded, entry, lens, way, cut_out)
        view = ReferenceView(stem, camera, load, known, cut_out=cut_out)
        views.append((stem, view.at(pose)))
    return by_stem(views)


def cut_out_image(view: TrainingView) -> tuple[ImageU8, MaskBool | None]:
    """Return a cut-out of a run over white, and its mask, in which empty pixels count."""
    image, mask = view.load()
    alpha = None if view.transparency is None else view.transparency()
    assert alpha is not None and image.dtype == np.uint8
    return over_white(image, alpha), None if mask is None else mask | (alpha <= 127)


def loaded(
    frame: SourceFrame, lens: Lens, way: Undistorter, cut_out: bool
) -> tuple[ImageU8, MaskBool | None]:
    image = read_image(frame)
    source_mask = None if cut_out and frame.mask is None else read_source_mask(frame)
    if cut_out:
        alpha = read_transparency(frame.path, upright=not is_as_stored(frame))
        assert alpha is not None  # `are_cut_outs`
        image = over_white(image, alpha)
    if image.shape[1::-1] != (lens.width, lens.height):
        raise InputError(
            f"{frame.path} has {image.shape[1]}x{image.shape[0]} pixels, "
            f"its camera {lens.width}x{lens.height}",
            hint="give the images at the size that transforms.json states (w, h)",
        )
    if source_mask is not None and source_mask.shape != image.shape[:2]:
        raise InputError(
            f"the mask {frame.mask} has {source_mask.shape[1]}x{source_mask.shape[0]} pixels, "
            f"its image {lens.width}x{lens.height}",
            hint="make masks of the size of their images",
        )
    image, source_mask = way.image(image), None if source_mask is None else way.mask(source_mask)
    if min(image.shape[:2]) < MIN_SIDE:
        raise InputError(
            f"{frame.path} has {image.shape[1]}x{image.shape[0]} pixels: too small to be compared",
            hint=f"give references of at least {MIN_SIDE} pixels on each side",
        )
    return image, None if source_mask is None else source_mask > 0


def stem_of(name: str) -> str:
    """Return a file's name without folder and image ending; the name of a video's frame may have dots."""
    path = Path(name)
    return path.stem if path.suffix.lower() in IMAGE_SUFFIXES else path.name


def by_stem(items: Iterable[tuple[str, T]]) -> dict[str, T]:
    found: dict[str, T] = {}
    for stem, item in items:
        if stem in found:
            raise InputError(
                f"two images are called {stem}: their stems do not distinguish them",
                hint="give each image a different name",
            )
        found[stem] = item
    return found
