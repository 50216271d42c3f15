"""Still images as RGB arrays, through OpenCV."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from cleargs.errors import InputError
from cleargs.files import write_bytes
from cleargs.media import IMAGE_SUFFIXES as IMAGE_SUFFIXES
from cleargs.media import MAX_PIXELS
from cleargs.media.photos import (
    decode_photo,
    open_photo,
    photo_format,
    photo_orientation,
    srgb_from_profile,
)
from cleargs.safe_io import cause, open_regular, read_bytes
from cleargs.types import AnyImage, ImageU8, MaskU8

_FORMATS = frozenset({"jpeg", "png", "webp", "tiff", "bmp", "jpegxl"})
"""Formats that are read, as OpenImageIO names them."""

_PHOTOS = frozenset({"heic", "avif"})
"""Formats that Pillow reads."""

_OPAQUE = frozenset({".jpg", ".jpeg", ".bmp"})

_METADATA = 2**18
"""Bytes at the start of a file in which its metadata are."""

_HINT = "copy the file again, convert it to JPEG or PNG, or remove it"

_MIRRORED = {
    1: (1, 1), 2: (1, -1), 3: (-1, -1), 4: (-1, 1), 5: (1, 1), 6: (1, -1), 7: (-1, -1), 8: (-1, 1)
}  # fmt: skip
"""EXIF's orientation -> steps through rows and columns of the stored image."""


class Header(NamedTuple):
    """Values in the header of an image file, from which the cost of decoding is known before."""

    width: int
    height: int
    orientation: int
    """EXIF's orientation, 1 to 8; 1 if there is none."""
    format: str
    profile: bytes = b""
    """The embedded ICC profile; empty if there is none."""


def read_header(path: Path) -> Header:
    """Return the header of the image in ``path``. Raises InputError if there is no image."""
    from OpenImageIO import ImageInput, geterror

    try:
        with open_regular(path) as file:
            head = file.read(12)
    except OSError as error:
        raise InputError(f"cannot read {path}: {cause(error)}", hint=_HINT) from error
    if kind := photo_format(head):
        with open_photo(path, kind) as photo:
            profile = photo.info.get("icc_profile") or b""
            return Header(*photo.size, photo_orientation(photo), kind, profile)
    source = ImageInput.open(str(path))
    if source is None:
        geterror()  # else OpenImageIO prints it on stderr at the end
    elif source.format_name() in _FORMATS:
        spec = source.spec()
        noted = spec.get_int_attribute("Orientation", 1)
        profile = spec.getattribute("ICCProfile")
        return Header(
            spec.width,
            spec.height,
            noted if 1 <= noted <= 8 else 1,
            source.format_name(),
            b"" if profile is None else bytes(profile),
        )
    fault = "is empty (zero bytes)" if not head else "is not an image that can be read"
    raise InputError(f"{path} {fault}", hint=_HINT)


def lens_name(path: Path) -> tuple[str, ...]:
    """Return camera, lens and focal lengths by the EXIF of the image in ``path``.

    Phones have several lenses whose images are of one size.
    """
    from OpenImageIO import ImageInput, geterror

    source = ImageInput.open(str(path))
    if source is None:
        geterror()
        return ()
    names = ("Model", "Exif:LensModel", "Exif:FocalLength", "Exif:FocalLengthIn35mmFilm")
    values = (source.spec().getattribute(name) for name in names)
    return tuple(f"{value:.1f}" if isinstance(value, float) else str(value) for value in values)


def is_panorama(path: Path) -> bool:
    """Return True if the metadata of the image in ``path`` say that it is equirectangular (XMP's GPano)."""
    with open_regular(path) as file:
        return b"equirectangular" in file.read(_METADATA)


def image_size(path: Path) -> tuple[int, int]:
    """Return width and height of the stored image in ``path``. Raises InputError like `read_header`."""
    header = read_header(path)
    return header.width, header.height


def read_rgb(path: Path, *, upright: bool = True) -> ImageU8:  # [H, W, 3]
    """Return the image in ``path`` as 8-bit sRGB [H, W, 3].

    Alpha is dropped, 16 bits are reduced to 8, and an ICC profile is converted to sRGB.

    Args:
        path: the image file.
        upright: turn it by its EXIF orientation.

    Raises:
        InputError: there is no readable image.
    """
    bgr = _decode(path, cv2.IMREAD_COLOR, upright=upright)
    return np.asarray(cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB), np.uint8)


def read_mask(path: Path) -> MaskU8:  # [H, W]
    """Return a mask [H, W]: 0 if the pixel is ignored, else 255. Raises InputError like `read_rgb`.

    The threshold is 127, or 0 for masks of 0 and 1, which some programs write.
    """
    grey = _decode(path, cv2.IMREAD_GRAYSCALE)
    border = 127 if grey.max() > 1 else 0
    return np.asarray(np.where(grey > border, 255, 0), np.uint8)


def read_alpha(path: Path, *, upright: bool = True) -> MaskU8 | None:  # [H, W]
    """Return the transparency of an image as a mask: 0 if it is more than half transparent, else 255.

    None if it is opaque everywhere. ``upright`` turns it, and errors are raised, as `read_rgb` does.
    """
    if path.suffix.lower() in _OPAQUE:
        return None
    image = _decode(path, cv2.IMREAD_UNCHANGED, upright=upright)
    if image.ndim != 3 or image.shape[2] != 4:
        return None
    opaque = image[..., 3] > np.iinfo(image.dtype).max // 2
    return None if opaque.all() else np.asarray(np.where(opaque, 255, 0), np.uint8)


def write_rgb(
    path: Path,
    image: AnyImage,  # [H, W, 3]
    *,
    quality: int | None = None,
) -> None:
    """Write an RGB image atomically in the format of its ending. Floats are sRGB, clipped to [0, 1].

    ``quality`` is that of a JPEG. Raises StoreError when the disk is full or not writable.
    """
    rgb = to_uint8(image)
    options = [] if quality is None else [cv2.IMWRITE_JPEG_QUALITY, quality]
    _, data = cv2.imencode(path.suffix, cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR), options)
    write_bytes(path, data.tobytes())


def write_mask(path: Path, mask: MaskU8) -> None:  # [H, W]
    """Write a one-channel image atomically. Raises StoreError like `write_rgb`."""
    write_bytes(path, cv2.imencode(path.suffix, mask)[1].tobytes())


def to_uint8(image: AnyImage) -> ImageU8:
    """Return floats in [0, 1] (clipped) rounded to 0..255; an image of bytes stays unchanged."""
    if image.dtype == np.uint8:
        return image
    return np.asarray(np.rint(np.clip(image, 0, 1) * 255), np.uint8)


def _decode(path: Path, flags: int, *, upright: bool = True) -> AnyImage:
    """Return the image [H, W, ...], turned by its EXIF orientation (``upright``) or as it is stored.

    It is decoded from memory, because OpenCV's file reader explains a failure only on stderr.
    """
    header = read_header(path)
    if header.width * header.height > MAX_PIXELS:
        raise InputError(
            f"{path} has {header.width}x{header.height} pixels; at most {MAX_PIXELS} are read",
            hint="reduce the image: no more than ingest.max_size of its long side is used anyway",
        )
    image = _stored(path, header, flags)
    if header.profile and flags == cv2.IMREAD_COLOR:
        rgb = np.ascontiguousarray(image[..., ::-1])
        image = srgb_from_profile(rgb, header.profile)[..., ::-1]
    # The image is as it is stored, except a TIFF, which OpenCV always turns.
    turn = header.orientation
    if header.format == "tiff":
        turn = 1 if upright else {6: 8, 8: 6}.get(turn, turn)  # the others undo themselves
    elif not upright:
        turn = 1
    if turn >= 5:  # mirrored at the diagonal, then as the first four
        image = image.swapaxes(0, 1)
    down, across = _MIRRORED[turn]
    return np.ascontiguousarray(image[::down, ::across])


def _stored(path: Path, header: Header, flags: int) -> AnyImage:
    """Return the image as it is stored, in OpenCV's order of channels, as its ``flags`` ask for it."""
    if header.format in _PHOTOS:
        with open_photo(path, header.format) as photo:
            return _as_flags_ask(decode_photo(path, photo), flags)
    try:
        content = read_bytes(path)
    except OSError as error:
        raise InputError(f"cannot read {path}: {cause(error)}", hint=_HINT) from error
    image: AnyImage | None = None
    if header.format == "jpegxl":
        from OpenImageIO import ImageInput, geterror

        source = ImageInput.open(str(path))
        pixels = None if source is None else source.read_image("uint8")
        if pixels is not None and pixels.ndim == 3:
            image = _as_flags_ask(pixels if pixels.shape[2] > 2 else pixels[..., [0, 0, 0]], flags)
        geterror()  # else OpenImageIO prints it on stderr at the end
    # libpng would report a truncated file on stderr.
    elif header.format != "png" or b"IEND" in content:
        with suppress(cv2.error):
            image = cv2.imdecode(np.frombuffer(content, np.uint8), flags | cv2.IMREAD_IGNORE_ORIENTATION)
    if image is None:
        raise InputError(f"{path} is not an image that can be read", hint=_HINT)
    return image


def _as_flags_ask(pixels: ImageU8, flags: int) -> ImageU8:  # [H, W, 3 or 4] RGB(A)
    """Return ``pixels`` as OpenCV's flags of `imdecode` ask for them."""
    alpha = pixels.shape[2] == 4
    if flags == cv2.IMREAD_UNCHANGED:
        code = cv2.COLOR_RGBA2BGRA if alpha else cv2.COLOR_RGB2BGR
    elif flags == cv2.IMREAD_GRAYSCALE:
        code = cv2.COLOR_RGBA2GRAY if alpha else cv2.COLOR_RGB2GRAY
    else:
        code = cv2.COLOR_RGBA2BGR if alpha else cv2.COLOR_RGB2BGR
    return np.asarray(cv2.cvtColor(pixels, code), np.uint8)
