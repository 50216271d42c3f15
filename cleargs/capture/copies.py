"""Second pictures and videos of the same shot: previews, reduced and edited copies, maps of its pixels."""

from __future__ import annotations

import re
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from filecmp import cmp
from pathlib import Path

from cleargs.capture.file_names import BLURRED, MAP, PREVIEW, PROCESSED, SECOND, names_below, without
from cleargs.media.headers import Header

_SMALL, FEW = 0.5, 0.25
"""Pictures whose long side is at most this share of the others' are previews if they are at most this share
of their number, or if they have the numbers of others in their names."""

_REDUCED = 0.75  # share of the long side up to which a folder with the names of another one has copies


def second_videos(videos: Sequence[Path]) -> list[Path]:
    """Return the smaller ones of files with one stem in one folder: a video in two formats."""
    largest: dict[Path, Path] = {}
    for path in sorted(videos, key=lambda path: -path.stat().st_size):
        largest.setdefault(path.with_suffix(""), path)
    return without(videos, list(largest.values()))


def previews_of(
    images: Sequence[Path], headers: Mapping[Path, Header | None], root: Path, *, few: bool
) -> list[Path]:
    """Return pictures that are much smaller than the others and few, or have the numbers of others.

    Those with names of previews count too, if they are ``few`` or that does not matter (next to videos).
    """
    sizes = {path: header.size for path in images if (header := headers[path]) is not None}
    counts = Counter(sizes.values())
    if not counts:
        return []
    main = max(counts, key=lambda size: (counts[size] * size[0] * size[1], size))
    others = [path for path, size in sizes.items() if max(size) > _SMALL * max(main)]
    numbers = {(path.parent, *re.findall(r"\d+", path.stem)) for path in others}
    small = [path for path in sizes if max(sizes[path]) <= _SMALL * max(main)]
    paired = [path for path in small if (path.parent, *re.findall(r"\d+", path.stem)) in numbers]
    found = small if len(small) <= FEW * len(others) else paired
    named = [path for path in others if any(map(PREVIEW.search, names_below(path, root)[-2:]))]
    return sorted({*found, *(named if not few or len(named) <= FEW * len(others) else [])})


def copies_of(images: Sequence[Path], headers: Mapping[Path, Header | None]) -> list[Path]:
    """Return pictures of folders that have the names of another folder in a smaller size or another format.

    Second copies in one folder (``IMG_1.HEIC`` next to ``IMG_1.JPG``) count too.
    """
    stems: dict[Path, Path] = {}
    second = [path for path in images if stems.setdefault(path.with_suffix(""), path) is not path]
    second += [path for path in without(images, second) if _is_second(path, stems)]
    second += _maps(without(images, second))
    folders: dict[Path, dict[str, Path]] = defaultdict(dict)
    for path in without(images, second):
        folders[path.parent][path.stem.lower()] = path
    kept: list[dict[str, Path]] = []

    def rank(folder: Path) -> tuple[bool, int]:
        pixels = sum(_pixels(headers[path]) for path in folders[folder].values())
        return bool(PROCESSED.search(folder.name)), -pixels

    for folder in sorted(folders, key=rank):
        files = folders[folder]
        if any(
            all(name in other and _is_copy(path, other[name], headers) for name, path in files.items())
            for other in kept
        ):
            second += files.values()
        else:
            kept.append(files)
    return second


def _maps(images: Sequence[Path]) -> list[Path]:
    """Return pictures named, or in folders named, as normals, labels or depth, with the number of another."""
    maps = [path for path in images if MAP.fullmatch(path.stem) or MAP.fullmatch(path.parent.name)]
    numbers = {_numbers(path) for path in without(images, maps)} - {()}
    return [
        path for path in maps if any(_numbers(path)[: n + 1] in numbers for n in range(len(_numbers(path))))
    ]


def _numbers(path: Path) -> tuple[str, ...]:
    return tuple(re.findall(r"\d+", path.stem))


def _is_second(path: Path, stems: Mapping[Path, Path]) -> bool:
    """Return True if ``path`` is named as an edited version of one of ``stems``, or is a second download."""
    for pattern, sharp in BLURRED:
        if (cover := pattern.fullmatch(path.stem)) and path.with_name(cover.expand(sharp)) in stems:
            return True
    if (found := SECOND.fullmatch(path.stem)) is None:
        return False
    first = stems.get(path.with_name(f"IMG_{found[1]}" if found[1] else found[2] or found[3]))
    return first is not None and (found[3] is None or cmp(path, first, shallow=False))


def _pixels(header: Header | None) -> int:
    return 0 if header is None else header.size[0] * header.size[1]


def _is_copy(path: Path, other: Path, headers: Mapping[Path, Header | None]) -> bool:
    """Return True if ``path`` is ``other`` in a smaller size, processed, in another format, or as it is."""
    own, its = headers[path], headers[other]
    if own is None or its is None:
        return False
    (w, h), (width, height) = own.size, its.size
    alike = abs(w * height - h * width) <= max(width, height) + max(w, h)
    smaller = max(w, h) <= _REDUCED * max(width, height)
    processed = bool(PROCESSED.search(path.parent.name))
    changed = smaller or processed or path.suffix.lower() != other.suffix.lower()
    return alike and (changed or cmp(path, other, shallow=False))
