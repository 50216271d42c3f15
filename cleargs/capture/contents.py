"""Contents of a folder: photographs, and what is next to them, by the headers of the files.

RGB-D cameras and scanning apps write depth and confidence maps next to their photographs, phones split their
photographs over folders, and exports have previews and reduced copies.
"""

from __future__ import annotations

import os
import re
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from cleargs.capture.capture import External, SourceFrame
from cleargs.capture.config import CaptureConfig
from cleargs.capture.copies import FEW, copies_of, previews_of, second_videos
from cleargs.capture.file_names import (
    BAND,
    INFRARED_NAME,
    PRODUCT_NAME,
    SMALL_VIDEO,
    SPOT_NAME,
    SYSTEM,
    names_below,
    of_shot,
    without,
)
from cleargs.capture.folders import frame_key, is_wanted, mask_externals, natural_key
from cleargs.capture.mask_files import folder_of_masks, masks_by_place, masks_by_stem, masks_of_photographs
from cleargs.capture.pairs import second_views
from cleargs.digest import files_under
from cleargs.errors import InputError
from cleargs.media import IMAGE_SUFFIXES, RAW_SUFFIXES, VIDEO_SUFFIXES
from cleargs.media.headers import Header, lacks_package, read_header

FEWEST = 3
"""A folder with fewer photographs is read as something else, if it has something else."""

LISTS = ("transforms.json", "transforms_train.json", "poses_bounds.npy", "sparse")
"""Files and folders with poses, by which a folder is a capture."""

MASKS, DEPTH, GREY, INFRARED = "mask%s", "depth map%s", "picture%s of one channel", "infrared picture%s"
ALONE = "mask%s without a photograph of the same name"
BELOW = "video%s in folders below"
VIDEOS, RAW, UNREADABLE = "video%s", "raw or other picture%s", "HEIC picture%s without pillow-heif"
PREVIEWS, COPIES, OUTSIDE = (
    "preview%s",
    "second picture%s, reduced or in another format",
    "picture%s outside images/",
)
BROKEN = "file%s that cannot be opened"
EXR, EXR_SUFFIX = "EXR picture%s, depth or rendered layers", ".exr"
VIEWS = "second picture%s of the same views"
OTHERS = "picture%s of captures with poses in folders below"
SPOT = "picture%s of panoramas from one spot"
DEEP_TIFF = "TIFF picture%s of one channel, depth or a spectral band"
SPECTRAL = "picture%s with other channels than red, green and blue"
BANDS = "picture%s of other spectral bands"
PRODUCTS = "picture%s named as a texture, map, panorama or screenshot"
PHOTOGRAPHS, UNWANTED = "photograph%s", "file%s by --only or --skip"
_HINTS = {
    VIDEOS: "photographs are taken; for the videos, give one as the input, or set --skip for the photographs",
    BELOW: "give their folder, or put all videos into one folder",
    BROKEN: "they are broken links or devices: put the files themselves in their places",
    VIEWS: "those as filmed are taken; --only and --skip choose, by the name of the folder",
    ALONE: "name masks like their photographs",
    SPOT: "--only takes them; pictures that only turn show no depth",
    SPECTRAL: "export red, green and blue as JPEG or PNG",
    BANDS: "the first band is taken; --only takes another, such as '*_3.tif'",
    RAW: "convert them to JPEG or PNG",
    UNREADABLE: "pip install 'cleargs[heif]', or convert them to JPEG",
}
"""Reason -> remedy, where the user may have expected that the files are used."""


@dataclass(frozen=True)
class Contents:
    """The media files below a folder."""

    root: Path
    photographs: Sequence[Path]
    """The pictures that show the scene, in the order of their names (`frame_key`)."""
    videos: Sequence[Path]
    """The videos in the folder itself, else all below it, in natural order."""
    masks: Mapping[Path, Path]
    """Photograph -> its mask. Those of ``masks/`` at the usual places are not here."""
    left_out: Mapping[str, Sequence[Path]]
    """Kind -> files that are not taken."""
    is_video: bool
    """True if the videos are the capture, not the photographs."""

    @property
    def folder(self) -> Path:
        """The lowest folder with all photographs: their names are relative to it."""
        parents = {path.parent for path in self.photographs}
        return Path(os.path.commonpath(parents)) if parents else self.root

    def frames(self) -> list[SourceFrame]:
        """Return the photographs as frames, with the masks of `masks`."""
        folder = self.folder
        names = {path: path.relative_to(folder).as_posix() for path in self.photographs}
        return [SourceFrame(name, path, mask=self.masks.get(path)) for path, name in names.items()]

    def externals(self) -> dict[str, External]:
        """Return photographs and masks by role (`Layout.externals`)."""
        folder = self.folder
        role = "capture" if folder == self.root else "images"
        names = {path.relative_to(folder).as_posix(): path for path in self.photographs}
        found: dict[str, External] = {role: names, **mask_externals(self.root)}
        if self.masks:
            found["masks_beside"] = {m.relative_to(self.root).as_posix(): m for m in self.masks.values()}
        return found

    def told(self) -> str:
        """Return one line on what is taken, from which folders, and what is left out."""
        counted = {kind: self._counted(kind, files) for kind, files in self.left_out.items() if files}
        masks = counted.pop(MASKS, None)
        kind, taken = (VIDEOS, self.videos) if self.is_video else (PHOTOGRAPHS, self.photographs)
        line = " and ".join(filter(None, ["read: " + self._counted(kind, taken), masks]))
        return f"{line}; left out: {', '.join(counted.values())}" if counted else line

    def warnings(self) -> tuple[str, ...]:
        """Return a line for each kind of files that the user may miss, with the remedy."""
        return tuple(
            f"left out: {self._counted(kind, files)}; {_HINTS[kind]}"
            for kind, files in self.left_out.items()
            if files and kind in _HINTS
        )

    def _counted(self, kind: str, files: Sequence[Path]) -> str:
        """Return the number of ``files`` with their names (up to three), or else with their folders."""
        if len(files) <= 3:
            places = [path.relative_to(self.root).as_posix() for path in files]
        else:
            folders = Counter(path.parent.relative_to(self.root).as_posix() for path in files)
            only = len(folders) == 1
            places = [f"{folder}/" if only else f"{folder}/ {count}" for folder, count in folders.items()]
            places = [] if places == ["./"] else [*places[:4], *(["..."] if len(places) > 4 else [])]
        names = f" ({', '.join(places)})" if places else ""
        return f"{len(files)} {kind % ('' if len(files) == 1 else 's')}{names}"


def contents_of(root: Path, config: CaptureConfig) -> Contents:
    """Return the media files below ``root``, sorted by what their headers say. Decodes no picture.

    Raises InputError if ``ingest.only`` and ``ingest.skip`` leave nothing.
    """
    found = media_files(root)
    wanted = [path for path in found if is_wanted(path, root, config)]
    if found and not wanted:
        raise InputError(
            f"ingest.only and ingest.skip leave out all {len(found)} pictures and videos of {root}",
            hint="give names, folders or patterns as they are below the input: 'cam0', 'shots/*', '*.png'",
        )
    left_out: dict[str, Sequence[Path]] = {UNWANTED: sorted(set(found) - set(wanted))}
    left_out[BROKEN] = [path for path in wanted if not path.is_file()]
    wanted = without(wanted, left_out[BROKEN])
    videos = [path for path in wanted if path.suffix.lower() in VIDEO_SUFFIXES]
    small, copies = _small_videos(videos, root), second_videos(videos)
    videos = without(videos, [*small, *copies])
    second_clips = second_views(videos, root)
    videos = without(videos, second_clips)
    top = [path for path in videos if path.parent == root] or videos
    left_out[BELOW] = without(videos, top)
    videos = sorted(top, key=lambda path: natural_key(path.relative_to(root).as_posix()))
    images = [path for path in wanted if path.suffix.lower() in IMAGE_SUFFIXES]
    raw = [path for path in wanted if path.suffix.lower() in RAW_SUFFIXES]
    stems = {of_shot(path) for path in images}
    left_out[RAW] = [path for path in raw if of_shot(path) not in stems]
    left_out[EXR] = [path for path in wanted if path.suffix.lower() == EXR_SUFFIX]
    left_out[UNREADABLE] = [path for path in images if lacks_package(path)]
    if len(left_out[UNREADABLE]) == len(images):  # reading the first one names the remedy
        left_out[UNREADABLE] = []
    images = without(images, left_out[UNREADABLE])
    inside = {path for path in images if path.parts[len(root.parts)] == "images" and path.parent != root}
    if inside:
        # The place of the images in all layouts: what is elsewhere was put there on purpose.
        left_out[OUTSIDE] = [p for p in images if p not in inside and not folder_of_masks(p, root)]
        images = without(images, left_out[OUTSIDE])
    left_out[OTHERS] = _of_other_captures(images, root, few=not videos)
    images = without(images, left_out[OTHERS])
    left_out[MASKS] = masks_by_place(images, root)
    headers = {path: read_header(path) for path in without(images, left_out[MASKS])}
    left_out[SPECTRAL] = [path for path, header in headers.items() if header and header.spectral]
    if left_out[SPECTRAL] and len(left_out[SPECTRAL]) == len(headers) and not videos:
        raise InputError(f"{root} has only {SPECTRAL % 's'}", hint=_HINTS[SPECTRAL])
    headers = {path: headers[path] for path in without([*headers], left_out[SPECTRAL])}
    for kind, names in ((SPOT, SPOT_NAME), (INFRARED, INFRARED_NAME)):
        left_out[kind] = _by_name(names, headers, root)
        headers = {path: headers[path] for path in without([*headers], left_out[kind])}
    masks = masks_by_stem(headers)
    left_out[MASKS] = [*left_out[MASKS], *masks]
    images, deep, left_out[GREY] = _by_channels({path: headers[path] for path in without([*headers], masks)})
    left_out[DEEP_TIFF] = [path for path in deep if path.suffix.lower() in (".tif", ".tiff")]
    left_out[DEPTH] = without(deep, left_out[DEEP_TIFF])
    left_out[BANDS] = _other_bands([path for path in images if _is_grey(headers[path])])
    images = without(images, left_out[BANDS])
    previews = previews_of(images, headers, root, few=not videos)
    left_out[PREVIEWS] = [*previews, *small]
    images = without(images, previews)
    products = [path for path in images if PRODUCT_NAME.fullmatch(path.stem) or _is_texture(path)]
    left_out[PRODUCTS] = products if len(products) <= FEW * (len(images) - len(products)) else []
    images = without(images, left_out[PRODUCTS])
    views = second_views(images, root)
    left_out[VIEWS] = [*second_clips, *views]
    images = without(images, views)
    second = copies_of(images, headers)
    left_out[COPIES] = [*second, *copies, *without(raw, left_out[RAW])]
    images = without(images, second)
    only_maps = any(header and header.deep for header in headers.values())
    only_maps &= all(_is_grey(headers[path]) for path in images)
    is_video = bool(videos) and (len(images) < FEWEST or only_maps)
    left_out[PHOTOGRAPHS if is_video else VIDEOS] = images if is_video else videos
    images.sort(key=lambda path: frame_key(path.relative_to(root).as_posix()))
    made = Contents(root, images, videos, {}, left_out, is_video)
    made = replace(made, masks=masks_of_photographs(images, made.folder, root, left_out[MASKS]))
    used = list(made.masks.values())
    alone = [] if is_video else without(left_out[MASKS], used)
    left_out[MASKS] = without(left_out[MASKS], alone)
    kind = ALONE if len(wanted) == len(found) else UNWANTED  # their photographs may not be wanted
    left_out[kind] = [*left_out.get(kind, ()), *alone]
    return made


def media_files(root: Path) -> list[Path]:
    """Return pictures and videos below ``root``, without hidden ones and those of runs."""
    suffixes = IMAGE_SUFFIXES | RAW_SUFFIXES | VIDEO_SUFFIXES | {EXR_SUFFIX}
    found = files_under(root, lambda folder: bool(SYSTEM.match(folder.name)))
    files = (path for path in found.values() if path.suffix.lower() in suffixes)
    return sorted(files, key=lambda path: (path.parent, path.name))


def _of_other_captures(images: Sequence[Path], root: Path, *, few: bool) -> list[Path]:
    """Return the pictures in folders below ``root`` that have poses, such as exports.

    There are none if few pictures (and no videos) are elsewhere.
    """
    below = {folder for path in images for folder in path.parents if root in folder.parents}
    own = {folder for folder in below if any((folder / name).exists() for name in LISTS)}
    found = [path for path in images if not own.isdisjoint(path.parents)]
    return found if len(images) - len(found) >= FEWEST or not few else []


def _by_name(names: re.Pattern[str], headers: Mapping[Path, Header | None], root: Path) -> list[Path]:
    """Return the pictures named so, in any format. If there are few others in colour, none is returned."""
    found = [path for path in headers if any(map(names.fullmatch, names_below(path, root)))]
    colour = [path for path in without(list(headers), found) if not _is_grey(headers[path])]
    return found if len(colour) >= FEWEST else []


def _is_grey(header: Header | None) -> bool:
    return header is not None and (header.grey or header.deep)


def _by_channels(headers: Mapping[Path, Header | None]) -> tuple[list[Path], list[Path], list[Path]]:
    """Return photographs, depth maps, and pictures of one channel that are neither.

    The photographs are the pictures in colour, or all grey ones if there are almost no others.
    """
    deep = [path for path, header in headers.items() if header is not None and header.deep]
    grey = [path for path, header in headers.items() if header is not None and header.grey]
    colour = without(without(list(headers), deep), grey)
    if len(colour) >= FEWEST or not (grey or deep):
        return colour, deep, grey
    return ([*colour, *grey], deep, []) if grey else ([*colour, *deep], [], [])


def _is_texture(path: Path) -> bool:
    """Return True if a mesh has the name of the picture, as KIRI Engine and Metashape export them."""
    return any(path.with_suffix(end).is_file() for end in (".mtl", ".obj", ".fbx", ".dae"))


def _other_bands(images: Sequence[Path]) -> list[Path]:
    """Return the pictures of all bands but the first, if there are as many of each place (``IMG_0000_1``)."""
    places: dict[Path, dict[str, Path]] = defaultdict(dict)
    for path in images:
        if found := BAND.fullmatch(path.stem):
            places[path.with_name(found[1])][found[2]] = path
    bands = {tuple(sorted(files)) for files in places.values()}
    if len(places) < FEWEST or len(bands) > 1 or sum(map(len, places.values())) < len(images):
        return []
    _, *others = bands.pop()
    return [files[band] for files in places.values() for band in others]


def _small_videos(videos: Sequence[Path], root: Path) -> list[Path]:
    """Return the videos named as previews or proxies of others; none if there are no others."""
    small = [path for path in videos if any(map(SMALL_VIDEO.fullmatch, names_below(path, root)))]
    return small if len(small) < len(videos) else []
