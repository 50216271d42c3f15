"""Names in an input folder: its images, its masks, and their order. Imports nothing heavy."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import TypeVar

from cleargs.capture.capture import External, SourceFrame
from cleargs.media import IMAGE_SUFFIXES

T = TypeVar("T")


def image_folders(root: Path) -> list[Path]:
    """``images/`` and its reductions ``images_N/`` (N times smaller, as LLFF and nerfstudio name them),
    largest images first; empty when ``root`` has none of them.
    """
    found = [(0, root / "images")] if (root / "images").is_dir() else []
    for folder in root.glob("images_*"):
        factor = folder.name.removeprefix("images_")
        if factor.isdecimal() and folder.is_dir():
            found.append((int(factor), folder))
    return [folder for _, folder in sorted(found)]


def image_files(folder: Path, *, below: bool = False) -> list[Path]:
    """The images in ``folder``, with ``below`` also those in its folders, but none that is hidden; in any
    order.
    """
    found = folder.rglob("*") if below else folder.iterdir()
    return [
        path
        for path in found
        if path.suffix.lower() in IMAGE_SUFFIXES
        and path.is_file()
        and is_inside(path.relative_to(folder).as_posix())
    ]


def is_inside(name: str) -> bool:
    """Return True if a listed ``name`` stays in its folder and is not hidden.

    Only such files are part of a folder's digest.
    """
    path = PurePosixPath(name)
    return not path.is_absolute() and not any(part.startswith(".") for part in path.parts)


def name_below_images(name: str) -> str:
    """The name of a listed image by its place below ``images/``."""
    return PurePosixPath(name).as_posix().removeprefix("images/")


def mask_folder(source: Path) -> Path | None:
    """Return the folder of masks next to (or in) the folder of images, or None."""
    neighbour = source.parent / "masks"
    if source.name == "images" and neighbour.is_dir():
        return neighbour
    return source / "masks" if (source / "masks").is_dir() else None


def mask_externals(source: Path) -> dict[str, External]:
    """The folder of masks, where there is one, as part of a layout's ``externals``."""
    masks = mask_folder(source)
    return {} if masks is None else {"masks": masks}


def masks_of(folder: Path | None, names: Sequence[str]) -> dict[str, Path]:
    """The masks in ``folder`` of the images of these ``names``: in the same place, by stem or full name (as
    COLMAP has them); elsewhere where no other image has that stem.
    """
    if folder is None:
        return {}
    found = {
        path.relative_to(folder).with_suffix("").as_posix(): path for path in image_files(folder, below=True)
    }
    stems = Counter(PurePosixPath(name).stem for name in names)
    masks = {}
    for name in names:
        path = PurePosixPath(name)
        spellings = [path.with_suffix("").as_posix(), name]
        spellings += [path.stem, path.name] if stems[path.stem] == 1 else []
        mask = next((found[spelling] for spelling in spellings if spelling in found), None)
        if mask is not None:
            masks[name] = mask
    return masks


def chosen(
    frames: Sequence[SourceFrame], source: Path, at_most: int, names: Sequence[str] | None = None
) -> tuple[SourceFrame, ...]:
    """At most so many of ``frames``, each with its mask in the input ``source``: the mask of its name, or of
    the one in ``names``, where it brings none.
    """
    names = [frame.name for frame in frames] if names is None else names
    masks = masks_of(mask_folder(source), names)
    return tuple(
        replace(frame, mask=frame.mask or masks.get(name))
        for frame, name in spread(list(zip(frames, names, strict=True)), at_most)
    )


def spread(items: Sequence[T], at_most: int) -> list[T]:
    """At most so many of ``items``, evenly by position, first and last included."""
    if len(items) <= at_most:
        return list(items)
    step = (len(items) - 1) / max(1, at_most - 1)
    return [items[round(index * step)] for index in range(at_most)]


def natural_key(text: str) -> list[tuple[int, int, str]]:
    """Sort key by which ``2.jpg`` comes before ``10.jpg``."""
    parts = re.split(r"(\d+)", text)
    return [(1, int(part), "") if part.isdigit() else (0, 0, part.lower()) for part in parts]


def frame_key(name: str) -> tuple[list[tuple[int, int, str]], str]:
    """Sort key of frames: `natural_key`, but ``train_`` and ``eval_`` before the file's name do not count.

    3dgs-deblur marks its split so (train_frame_00001.png, eval_frame_00002.png); sorted with these prefixes,
    the test frames would all come before the others, out of the order in which they were taken.
    """
    return natural_key(re.sub(r"(?<![^/])(train|eval)_(?=[^/]*$)", "", name)), name
