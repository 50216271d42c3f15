"""Where things lie in an input folder. Looks at names only and imports nothing heavy: the runner asks this of
every run, also of one with nothing to do."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Literal, Protocol

from cleargs.capture.config import IngestConfig
from cleargs.capture.listing import read_listing
from cleargs.media import IMAGE_SUFFIXES
from cleargs.pipeline.stage import External
from cleargs.plugins import load_part

if TYPE_CHECKING:
    from cleargs.capture.sources import Capture


class Layout(Protocol):
    """How another package reads an input; a module, say."""

    def externals(self, source: Path, config: IngestConfig) -> Mapping[str, External]:
        """Role -> file, folder, or single files by name: all that is read. Looks at names only."""
        ...

    def open_capture(self, source: Path, config: IngestConfig) -> Capture:
        """The frames in trajectory order, at most ``config.max_frames``, with what is known of cameras and
        poses. Decodes no frame; changes nothing. Raises InputError."""
        ...


POSES_BOUNDS = "poses_bounds.npy"
"""LLFF's file of poses."""


def folder_kind(root: Path, *, poses: bool) -> Literal["transforms", "colmap", "llff", "images"]:
    """What the folder ``root`` is taken for; without ``poses``, its poses count for nothing."""
    if (root / "transforms.json").is_file():
        return "transforms"
    if poses and find_model(root) is not None:
        return "colmap"
    if poses and (root / POSES_BOUNDS).is_file():
        return "llff"
    return "images"


def image_folders(root: Path) -> list[Path]:
    """``images/`` and its reductions ``images_N/`` (N times smaller, as LLFF and nerfstudio name them),
    largest images first; empty when ``root`` has none of them."""
    found = [(0, root / "images")] if (root / "images").is_dir() else []
    for folder in root.glob("images_*"):
        factor = folder.name.removeprefix("images_")
        if factor.isdecimal() and folder.is_dir():
            found.append((int(factor), folder))
    return [folder for _, folder in sorted(found)]


def source_of_images(root: Path) -> Path:
    """The folder of a capture that is nothing but images: the first that holds any of ``images/``, ``root``
    itself, and the reductions, the largest first; ``root`` where none does."""
    folders = [root / "images", root, *image_folders(root)]
    return next((folder for folder in folders if folder.is_dir() and image_files(folder)), root)


def image_files(folder: Path, *, below: bool = False) -> list[Path]:
    """The images in ``folder``, with ``below`` also those in its folders, but none that is hidden; in any
    order."""
    found = folder.rglob("*") if below else folder.iterdir()
    return [
        path
        for path in found
        if path.suffix.lower() in IMAGE_SUFFIXES
        and path.is_file()
        and lies_below(path.relative_to(folder).as_posix())
    ]


def find_model(root: Path) -> Path | None:
    """The folder of the sparse model of a COLMAP project, or None."""
    for folder in (root / "sparse" / "0", root / "sparse", root / "colmap" / "sparse" / "0"):
        if any((folder / f"images.{kind}").is_file() for kind in ("bin", "txt")):
            return folder
    return None


def mask_folder(source: Path) -> Path | None:
    """The folder of masks beside (or in) the folder of images, or None."""
    beside = source.parent / "masks"
    if source.name == "images" and beside.is_dir():
        return beside
    return source / "masks" if (source / "masks").is_dir() else None


def externals(source: Path, config: IngestConfig) -> Mapping[str, External]:
    """What ingest reads of ``source``: role -> file, folder, or single files by name.

    A missing input is left to ingest to name. Raises InputError where transforms.json cannot be read.
    """
    if config.layout != "auto":
        layout: Layout = load_part("layouts", config.layout)
        return layout.externals(source, config)
    if not source.is_dir():
        return {"capture": source}
    kind = folder_kind(source, poses=config.poses == "auto")
    transforms = source / "transforms.json"
    found: dict[str, External]
    if kind == "llff":
        found = {"poses_bounds": source / POSES_BOUNDS}
        found.update((folder.name, folder) for folder in image_folders(source))
    elif kind == "transforms":
        found = {"transforms": transforms, "images": read_listing(transforms).files}
    else:
        images = source / "images" if kind == "colmap" else source_of_images(source)
        found = {"capture": source} if images == source else {"images": images}
    if (masks := mask_folder(source)) is not None:
        found["masks"] = masks
    if kind == "colmap" and (model := find_model(source)) is not None:
        found["sparse"] = model
    return found


def lies_below(name: str) -> bool:
    """Whether a listed ``name`` stays in its folder and is not hidden: only such files are part of a folder's
    digest."""
    path = PurePosixPath(name)
    return not path.is_absolute() and not any(part.startswith(".") for part in path.parts)
