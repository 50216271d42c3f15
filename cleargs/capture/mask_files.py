"""Masks among the pictures of a folder: by their folders, their names and their pixels."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path

from cleargs.capture.file_names import MASK_FOLDER
from cleargs.capture.folders import masks_by_number, masks_of, unmasked
from cleargs.errors import InputError
from cleargs.media.headers import Header

_WHITE, _MASK_SHARE = 255, 0.95
"""Level of white, and least share of black and white pixels in a mask; edges may be smooth."""


def folder_of_masks(path: Path, root: Path) -> Path | None:
    """Return the folder of masks below ``root`` that has the file ``path``, or None."""
    depth = len(root.parts)
    found = (n for n, part in enumerate(path.parts[depth:-1], depth) if MASK_FOLDER.fullmatch(part))
    return next((Path(*path.parts[: n + 1]) for n in found), None)


def masks_by_place(images: Sequence[Path], root: Path) -> list[Path]:
    """Return the masks among ``images``, by their folders and names. If all would be masks, none is one."""
    stems = {path.with_suffix("") for path in images}
    masks = [
        path
        for path in images
        if folder_of_masks(path, root) or (unmasked(path) != path.with_suffix("") and unmasked(path) in stems)
    ]
    return masks if len(masks) < len(images) else []


def masks_by_stem(headers: Mapping[Path, Header | None]) -> list[Path]:
    """Return the PNG files that are masks of a photograph of the same stem and size in their folder.

    The first one of each folder decides.
    """
    shots = {p.with_suffix(""): p for p, header in headers.items() if p.suffix.lower() in (".jpg", ".jpeg")}
    masks: dict[Path, list[Path]] = defaultdict(list)
    for path, header in headers.items():
        shot = headers.get(shots.get(path.with_suffix(""), path))
        if (
            path.suffix.lower() == ".png"
            and header
            and shot
            and header is not shot
            and header.size == shot.size
        ):
            masks[path.parent].append(path)
    return [path for paths in masks.values() if _looks_like_a_mask(paths[0]) for path in paths]


def _looks_like_a_mask(path: Path) -> bool:
    """Return True for a picture in black and white, or one whose pixels are white where it is opaque."""
    from cleargs.media.image import read_alpha, read_grey

    try:
        levels, alpha = read_grey(path), read_alpha(path, upright=False)
    except InputError:
        return False
    if alpha is not None and not alpha.all():
        return bool((levels[alpha > 0] == _WHITE).all())
    return bool(((levels == 0) | (levels == _WHITE)).mean() > _MASK_SHARE)


def masks_of_photographs(
    photographs: Sequence[Path], folder: Path, root: Path, masks: Sequence[Path]
) -> dict[Path, Path]:
    """Return photograph -> its mask, in a folder of masks or next to it (``NAME_mask.png``).

    ``folder`` is the lowest one with all ``photographs``, ``root`` that of the capture.
    """
    by_stem = {path.with_suffix(""): path for path in photographs}
    names = {path.relative_to(folder).as_posix(): path for path in photographs}
    found = {by_stem[unmasked(mask)]: mask for mask in masks if unmasked(mask) in by_stem}
    for place in dict.fromkeys(folder_of_masks(mask, root) for mask in masks):
        if place is not None:
            of = masks_of(place, list(names)) or masks_by_number(place, list(names))
            found |= {names[name]: mask for name, mask in of.items()}
    return found
