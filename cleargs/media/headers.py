"""Facts about an image from its header alone, through Pillow. Imports nothing heavy."""

from __future__ import annotations

import warnings
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple

from cleargs.safe_io import FAULTS, open_regular

HEIF_SUFFIXES = frozenset({".heic", ".heif", ".hif", ".heics"})
"""File endings of images that need the package pillow-heif."""

_TIFF_TAGS = (256, 257, 277)  # width, height, samples per pixel

_GREY = ("1", "L", "LA", "La", "P", "PA")


class Header(NamedTuple):
    """Size and channels of an image."""

    size: tuple[int, int]
    """Stored width and height."""
    grey: bool
    """True if the image has one channel, of 8 bits or fewer. Palettes count: masks and labels have them."""
    deep: bool
    """True if the image has one channel of more than 8 bits, as depth maps have."""
    spectral: bool = False
    """True if it is a TIFF file of other channels than colours: spectral bands, or Lab."""


def read_header(path: Path) -> Header | None:
    """Return the header of the image in ``path``; None if Pillow cannot read it."""
    from PIL import Image

    with suppress(SyntaxError, Image.DecompressionBombError, *FAULTS):  # an unidentified image: OSError
        open_regular(path).close()
        with warnings.catch_warnings(action="ignore"):
            if path.suffix.lower() in HEIF_SUFFIXES and find_spec("pillow_heif"):
                import pillow_heif

                pillow_heif.register_heif_opener()
            with Image.open(path) as image:
                deep = image.mode.startswith(("I", "F"))
                return Header(image.size, image.mode in _GREY, deep, image.mode == "LAB")
    return _spectral_header(path) if path.suffix.lower() in (".tif", ".tiff") else None


def _spectral_header(path: Path) -> Header | None:
    """Return the header of a whole TIFF file that Pillow cannot read; None if it is damaged."""
    from PIL.TiffImagePlugin import ImageFileDirectory_v2

    with suppress(SyntaxError, *FAULTS), open_regular(path) as file:
        directory = ImageFileDirectory_v2(file.read(8))
        file.seek(directory.next)
        directory.load(file)
        width, height, samples = (int(directory[tag]) for tag in _TIFF_TAGS)
        return Header((width, height), False, False, spectral=True) if samples > 1 else None
    return None


def lacks_package(path: Path) -> bool:
    """Return True if the image in ``path`` can only be read with a package that is not installed."""
    return path.suffix.lower() in HEIF_SUFFIXES and find_spec("pillow_heif") is None
