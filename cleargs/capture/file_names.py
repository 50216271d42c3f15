"""Names by which cameras, apps and programs mark files that are not photographs of the scene."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

SYSTEM = re.compile(r"[.@#]|(__MACOSX|MeshroomCache|odm_\w+|.+\.(files|cmvs))$")
"""Names of hidden folders, of network disks' own, and of the work of Meshroom, ODM, Metashape, VisualSFM."""
MASK_FOLDER = re.compile(r"(.+[._-])?masks?", re.IGNORECASE)
PROCESSED = re.compile(
    r"correct|undist|rectif|edit|resiz|enhanc|upscal|denois|sharpen|deblur|render|export|"
    r"normal|semantic|segment|label|instance|albedo|depth|dispar|flow",
    re.IGNORECASE,
)
PREVIEW = re.compile(r"thumb|thmbnl|preview|poster|contact.?sheet", re.IGNORECASE)
SECOND = re.compile(r"IMG_E(\d+)|(.+)[-_ ]edited|(.+) \(?\d+\)?", re.IGNORECASE)
"""Names of second versions: edited on iPhones, by Google Photos, and downloaded twice."""
BLURRED = (
    (re.compile(r"(.+\.PORTRAIT-)\d+\.COVER"), r"\g<1>02.ORIGINAL"),
    (re.compile(r"\d+l?PORTRAIT_\d+_(BURST\d+)_COVER"), r"00000PORTRAIT_00000_\1"),
)
"""Names of the portraits of a Pixel whose background it blurred, and those of the sharp ones next to them."""
BAND = re.compile(r"(.+)_(\d{1,2})")  # name of a picture of one spectral band (MicaSense)


def _words(words: str, more: str = "$.") -> re.Pattern[str]:
    """Return a pattern for names with one of ``words``, between other characters than letters."""
    return re.compile(rf"(.*[\W\d_])?({words})([\W\d_].*)?|{more}", re.IGNORECASE)


MAP = _words(
    "normals?|semantics?|seg|segmentation|labels?|instances?|albedo|depths?|disparity|flow|masked|vis|viz|overlay"
)
INFRARED_NAME = _words("infra(red)?|n?ir|thermal", r"DJI_.+_T(HRM)?")
SPOT_NAME = _words(r"sky.?box\d*", r"\d*_?pano(rama)?s?")
PRODUCT_NAME = _words("screen.?shot|texture|diffuse|map_kd|ortho(photo|mosaic)?|dsm|dem|pano(rama)?")
SMALL_VIDEO = _words("lrv|proxy|proxies|low.?res")


def of_shot(path: Path) -> Path:
    """Return ``path`` without its ending and what a Pixel adds for raw photographs and their JPEGs."""
    return path.with_name(re.sub(r"\.RAW-\d+(\.MP)?\.(COVER|ORIGINAL)$", "", path.stem))


def names_below(path: Path, root: Path) -> tuple[str, ...]:
    """Return the names of the folders below ``root`` on the way to ``path``, and its stem."""
    return path.relative_to(root).with_suffix("").parts


def without(files: Sequence[Path], others: Sequence[Path]) -> list[Path]:
    """Return ``files`` without ``others``, in their order."""
    gone = set(others)
    return [path for path in files if path not in gone]
