"""Names in an input folder: its images, its masks, and their order. Imports nothing heavy."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from fnmatch import fnmatchcase
from pathlib import Path, PurePosixPath

from cleargs.capture.capture import External, SourceFrame
from cleargs.capture.config import CaptureConfig
from cleargs.capture.pairs import version_rank
from cleargs.digest import files_under, has_results, is_inside
from cleargs.errors import InputError, listed
from cleargs.media import IMAGE_SUFFIXES
from cleargs.sequences import spread

_MASK_NAME = re.compile(r"(?:mask[._-])?(.+?)(?:[._-]masks?)?", re.IGNORECASE)


def image_folders(root: Path) -> list[Path]:
    """Return ``images/`` and its reductions ``images_N/`` below ``root``, the largest images first.

    LLFF and nerfstudio use this name for a folder of images that are N times smaller.
    """
    factors = {root / "images": 0}
    for folder in root.glob("images_*"):
        if (factor := folder.name.removeprefix("images_")).isdecimal():
            factors[folder] = int(factor)
    return [folder for folder in sorted(factors, key=lambda folder: factors[folder]) if folder.is_dir()]


def image_files(folder: Path, *, below: bool = False) -> list[Path]:
    """Return the images in ``folder`` (``below``: in its subfolders too), unordered, without hidden ones."""
    files = files_under(folder).values() if below else folder.iterdir()
    return [
        path
        for path in files
        if path.suffix.lower() in IMAGE_SUFFIXES and not path.name.startswith(".") and path.is_file()
    ]


def folders_to_search(root: Path) -> list[Path]:
    """Return the folders with images: ``images/``, its reductions, others except ``masks/``, and ``root``."""
    others = sorted(path for path in root.iterdir() if path.is_dir() and is_inside(path.name))
    others = [path for path in others if not has_results(path)]
    others.sort(key=lambda path: version_rank(path.name))  # those as filmed before sharp ones
    folders = dict.fromkeys([*image_folders(root), *others, root])
    folders.pop(root / "masks", None)
    return [folder for folder in folders if image_files(folder, below=folder != root)]


def find_images(root: Path, names: Sequence[str]) -> tuple[Path, dict[str, Path], bool]:
    """Return the folder in ``root`` with most images of ``names``, name -> path, and True if found by stems.

    Images with exactly these names are searched first. If no folder has any, images with the same stems are
    searched, with any suffix and case.
    """
    best: tuple[Path, dict[str, Path], bool] = (root / "images", {}, False)
    for by_stem in (False, True):
        for folder in folders_to_search(root):
            files = image_files(folder, below=True)
            stored = {_spelling(path.relative_to(folder).as_posix(), by_stem): path for path in files}
            paths = {name: stored.get(_spelling(name_below_images(name), by_stem)) for name in names}
            found = {name: path for name, path in paths.items() if path is not None}
            if len(found) > len(best[1]):
                best = folder, found, by_stem
        if best[1]:
            break
    return best


def _spelling(name: str, by_stem: bool) -> str:
    return PurePosixPath(name).with_suffix("").as_posix().lower() if by_stem else name


def require_most(missing: Sequence[str], total: int, listing: str) -> tuple[str, ...]:
    """Return a note on the ``missing`` of ``total`` images in ``listing``, or nothing if all exist.

    Raises InputError if more than half of the images are missing.
    """
    if not missing:
        return ()
    lost = f"images that do not exist: {listed(missing)}"
    if 2 * len(missing) > total:
        raise InputError(
            f"{listing} lists {len(missing)} {lost}",
            hint="put the images where it says, remove the entries, or set ingest.poses=sfm",
        )
    return (f"{listing} lists {len(missing)} of {total} {lost}; they are left out",)


def is_wanted(path: Path, root: Path, config: CaptureConfig) -> bool:
    """Return True if ``ingest.only`` and ``ingest.skip`` leave the file ``path`` in the capture ``root``.

    A pattern may be a name or a path below ``root``, of the file or of one of its folders.
    """
    if config.only is None and config.skip is None:
        return True
    below = PurePosixPath(path.relative_to(root) if path.is_relative_to(root) else path.name)
    spellings = {*map(str, (below, *below.parents)), *below.parts}

    def fits(patterns: str) -> bool:
        listed = filter(None, (part.strip().strip("/") for part in patterns.split(",")))
        return any(fnmatchcase(spelling, pattern) for pattern in listed for spelling in spellings)

    return (config.only is None or fits(config.only)) and not (config.skip is not None and fits(config.skip))


def name_below_images(name: str) -> str:
    """Return the name of a listed image relative to ``images/``."""
    return PurePosixPath(name).as_posix().removeprefix("images/")


def mask_folder(source: Path) -> Path | None:
    """Return the folder of masks next to (or in) the folder of images, or None."""
    neighbour = source.parent / "masks"
    if source.name == "images" and neighbour.is_dir():
        return neighbour
    return source / "masks" if (source / "masks").is_dir() else None


def mask_externals(source: Path) -> dict[str, External]:
    """Return the folder of masks, if there is one, as part of a layout's ``externals``."""
    masks = mask_folder(source)
    return {} if masks is None else {"masks": masks}


def unmasked(path: Path) -> Path:
    """Return ``path`` without its ending and without the word "mask" at either end of its name."""
    found = _MASK_NAME.fullmatch(path.stem)
    return path.with_name(found[1] if found else path.stem)


def masks_of(folder: Path | None, names: Sequence[str]) -> dict[str, Path]:
    """Return the masks in ``folder``, by the names of their images.

    A mask has the same relative path as its image, with the stem or the full name (COLMAP's form). Its
    name may begin or end with the word "mask" (Metashape's form). If only one image has its stem, the mask
    may be in another subfolder.
    """
    if folder is None:
        return {}
    files = {path.relative_to(folder): path for path in image_files(folder, below=True)}
    found = {unmasked(below).as_posix(): path for below, path in files.items()}
    found |= {below.with_suffix("").as_posix(): path for below, path in files.items()}
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


def masks_by_number(folder: Path, names: Sequence[str]) -> dict[str, Path]:
    """Return the masks in ``folder`` by the names of their images, if both names are numbers (DTU).

    The zeros in front may differ. None is returned if a mask has no image: it may count from another number.
    """
    files = image_files(folder, below=True)
    images = {int(stem): name for name in names if (stem := PurePosixPath(name).stem).isdecimal()}
    masks = {int(path.stem): path for path in files if path.stem.isdecimal()}
    whole = len(images) == len(names) and len(masks) == len(files) and masks.keys() <= images.keys()
    return {images[number]: path for number, path in masks.items()} if whole else {}


def chosen(
    frames: Sequence[SourceFrame], source: Path, at_most: int, names: Sequence[str] | None = None
) -> tuple[SourceFrame, ...]:
    """Return at most ``at_most`` of ``frames``, evenly, with their masks in the input ``source``.

    Masks are found by ``names`` (None: the names of the frames). A frame that has a mask keeps it.
    """
    names = [frame.name for frame in frames] if names is None else names
    masks = masks_of(mask_folder(source), names)
    return tuple(
        replace(frame, mask=frame.mask or masks.get(name))
        for frame, name in spread(list(zip(frames, names, strict=True)), at_most)
    )


def listed_pictures(frames: Sequence[SourceFrame], source: Path, listing: str) -> str:
    """Return a line on the pictures that a ``listing`` of poses names, and on those that are left out."""
    taken, masks = {frame.path for frame in frames}, mask_folder(source)
    others = [path for path in image_files(source, below=True) if masks not in path.parents]
    places = Counter(path.parent.relative_to(source).as_posix() for path in others if path not in taken)
    posed = sum(frame.pose is not None for frame in frames)
    line = f"read: {len(frames)} pictures, {posed} with a pose in {listing}"
    if not places:
        return line
    named = [f"{place}/ {count}" for place, count in sorted(places.items())]
    return (
        f"{line}; left out: {places.total()} others ({', '.join([*named[:4], *['...'][: len(named) - 4]])})"
    )


def natural_key(text: str) -> list[tuple[int, int, str]]:
    """Return a sort key by which ``2.jpg`` comes before ``10.jpg``."""
    parts = re.split(r"(\d+)", text)
    return [(1, int(part), "") if part.isdigit() else (0, 0, part.lower()) for part in parts]


def frame_key(name: str) -> tuple[list[tuple[int, int, str]], str]:
    """Return `natural_key` without a prefix ``train_`` or ``eval_`` of the file name.

    3dgs-deblur marks its split by these prefixes (train_frame_00001.png, eval_frame_00002.png). Sorted with
    them, all test frames would come first, out of the order in which they were taken.
    """
    return natural_key(re.sub(r"(?<![^/])(train|eval)_(?=[^/]*$)", "", name)), name
