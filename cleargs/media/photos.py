"""Photographs that OpenCV does not read as they are meant: HEIC and AVIF files, and embedded ICC profiles.

Pillow reads AVIF. It reads HEIC with the package pillow-heif (the extra ``cleargs[heif]``). Its LittleCMS
converts from profiles.
"""

from __future__ import annotations

import io
import warnings
from contextlib import suppress
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageCms

from cleargs.errors import InputError
from cleargs.safe_io import FAULTS, cause

_FAULTS: tuple[type[Exception], ...] = (*FAULTS, SyntaxError, Image.DecompressionBombError)
"""Errors that Pillow raises for a file of the wrong form."""

_HEIC = frozenset({b"heic", b"heix", b"heim", b"heis", b"hevc", b"hevx", b"mif1", b"msf1"})
_AVIF = frozenset({b"avif", b"avis"})
_ORIENTATION = 274  # EXIF's number for it


def photo_format(head: bytes) -> str | None:
    """Return ``heic`` or ``avif`` by the first 12 bytes of a file (ISO/IEC 23008-12); None for neither."""
    if head[4:8] != b"ftyp":
        return None
    return "avif" if head[8:12] in _AVIF else "heic" if head[8:12] in _HEIC else None


def open_photo(path: Path, kind: str) -> Image.Image:
    """Open the HEIC or AVIF file ``path`` without decoding it.

    Raises:
        InputError: HEIC without pillow-heif, or no readable image.
    """
    if kind == "heic":
        try:
            import pillow_heif
        except ImportError as error:
            raise InputError(
                f"{path} is a HEIC image, which needs the package pillow-heif",
                hint="pip install 'cleargs[heif]', or convert the images to JPEG",
            ) from error
        pillow_heif.register_heif_opener()
    try:
        with warnings.catch_warnings(action="ignore"):  # about its size, which is checked elsewhere
            return Image.open(path)
    except _FAULTS as error:
        raise _unreadable(path, error) from error


def _unreadable(path: Path, error: Exception) -> InputError:
    return InputError(
        f"{path} is not an image that can be read: {cause(error)}",
        hint="copy the file again, convert it to JPEG or PNG, or remove it",
    )


def photo_orientation(photo: Image.Image) -> int:
    """Return the EXIF orientation (1 to 8) in which ``photo`` is stored; 1 where it has none."""
    noted = photo.getexif().get(_ORIENTATION, 1)
    return int(noted) if noted in range(1, 9) else 1


def decode_photo(path: Path, photo: Image.Image) -> NDArray[np.uint8]:
    """Return ``photo`` as 8-bit RGB [H, W, 3], or RGBA [H, W, 4] where it has transparency.

    Raises:
        InputError: the file is damaged.
    """
    try:
        return np.asarray(photo.convert("RGBA" if photo.has_transparency_data else "RGB"), np.uint8)
    except _FAULTS as error:
        raise _unreadable(path, error) from error


def srgb_from_profile(rgb: NDArray[np.uint8], profile: bytes) -> NDArray[np.uint8]:  # [H, W, 3]
    """Return ``rgb`` converted from its ICC ``profile`` to sRGB, relative colorimetric.

    Stays as it is where the profile is sRGB's own, is not one of RGB, or is damaged.
    """
    with suppress(ImageCms.PyCMSError, *_FAULTS):
        source = ImageCms.getOpenProfile(io.BytesIO(profile))
        if "srgb" in ImageCms.getProfileDescription(source).lower():
            return rgb
        if source.profile.xcolor_space.strip() == "RGB":
            converted = ImageCms.profileToProfile(
                Image.fromarray(rgb),
                source,
                ImageCms.createProfile("sRGB"),
                renderingIntent=ImageCms.Intent.RELATIVE_COLORIMETRIC,
            )
            return np.asarray(converted, np.uint8)
    return rgb
