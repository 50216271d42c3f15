"""Files other than captures: what they are by their endings, and what to give in their place."""

from __future__ import annotations

import re
from pathlib import Path

from cleargs.errors import InputError
from cleargs.media import IMAGE_SUFFIXES, RAW_SUFFIXES, VIDEO_SUFFIXES

_GIVE = "give a video, or a folder of images"
_SCENES = "cleargs export, render and eval read scenes; cleargs run makes one from a video or images"

_MODELS = (
    ".ply .splat .spz .sog .ksplat .glb .gltf .obj .fbx .dae .stl .abc .usd .usda .usdc .usdz .3mf .wrl .x3d"
)

_KINDS = (
    ("a file of a photo editor", ".xmp .dop .pp3 .on1 .cos", _GIVE),
    ("a list of edits of an iPhone photograph", ".aae", _GIVE),
    ("the preview of a video", ".thm", _GIVE),
    ("the small copy of a video", ".lrv .lrf", _GIVE),
    ("a file of subtitles or of a flight", ".srt .ass .vtt", _GIVE),
    ("a file of data", ".json .csv .xml .yaml .yml .toml .ini .txt .log .gpx .kml .npy .npz .pkl", _GIVE),
    ("a document", ".pdf .html .md .doc .docx .xlsx .pptx", _GIVE),
    ("a sound", ".wav .mp3 .m4a .aac .flac", _GIVE),
    ("an archive", ".zip .tar .gz .tgz .xz .bz2 .zst .7z .rar", "unpack it, and give its folder"),
    ("a 3D scene or model", _MODELS, _SCENES),
    ("a laser scan", ".las .laz .e57 .pts .ptx", _GIVE),
    (
        "a recording of a camera",
        ".bag .db3 .mcap .svo .svo2 .vrs .r3d .klg .sens",
        "export its pictures into a folder",
    ),
    ("a raw video", ".braw .mlv .crm .ari", "export it as MP4 with the camera's program"),
    (
        "a project or an export of another program",
        ".psx .psz .rcproj .p4d .mg .sfm .psht .blend .nvm .out .lrcat .prproj .drp .pcd",
        _GIVE,
    ),
    (
        "a recording of a 360 degree camera",
        ".insv .insp .360",
        "export a flat video of it with the camera's program",
    ),
    ("a raw or other picture", " ".join(RAW_SUFFIXES), "convert it to JPEG or PNG, and give its folder"),
)
"""Kind of file, its endings (lower case), and the remedy."""

_MEDIA = IMAGE_SUFFIXES | VIDEO_SUFFIXES

_READABLE = frozenset({".lrv", ".lrf", ".thm"})
"""Endings of small copies of videos, which FFmpeg reads."""


def kind_of(path: Path) -> tuple[str, str] | None:
    """Return the kind of the file ``path`` by its ending, and the remedy; None if it may be a capture."""
    return next(((kind, hint) for kind, ends, hint in _KINDS if path.suffix.lower() in ends.split()), None)


def remedy_in(folder: Path, otherwise: str) -> str:
    """Return a hint for a ``folder`` with too few images: a file in it that must be converted, if any."""
    files = [(path.name, kind_of(path)) for path in sorted(folder.iterdir()) if path.is_file()]
    named = (f"{name} is {kind[0]}: {kind[1]}" for name, kind in files if kind and kind[1] != _GIVE)
    return next(named, otherwise)


def refused(path: Path, kind: str, hint: str) -> InputError:
    """Return the error for such a file. Its hint names a video or the pictures in its folder."""
    beside = [file for file in sorted(path.parent.iterdir()) if file.suffix.lower() in _MEDIA]
    its = next((video for video in beside if _is_original(video, path)), None)
    if its is not None:
        hint = f"give {its}, the video to which it belongs"
    elif beside:
        hint = f"give its folder {path.parent}, which has pictures or videos"
    return InputError(f"{path.name} is {kind}", hint=hint)


def is_small_copy(path: Path) -> bool:
    """Return True if ``path`` is a preview or a small copy of a video in its folder."""
    if path.suffix.lower() not in _READABLE or not path.is_file():
        return False
    return any(_is_original(file, path) for file in path.parent.iterdir())


def _is_original(video: Path, path: Path) -> bool:
    """Return True if the names have the same stem or number, as GX010123.MP4 and GL010123.LRV."""
    if video.suffix.lower() not in VIDEO_SUFFIXES:
        return False
    return video.stem == path.stem or _number(video) == _number(path) != ""


def _number(path: Path) -> str:
    return "".join(re.findall(r"\d+", path.stem))
