"""Still images as 8-bit sRGB arrays, through Pillow; JPEG XL through OpenImageIO."""

from __future__ import annotations

import io
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import cv2
import numpy as np
from PIL import Image, ImageCms, ImageOps, UnidentifiedImageError

from cleargs.errors import InputError
from cleargs.files import write_bytes
from cleargs.media import MAX_PIXELS
from cleargs.safe_io import FAULTS, cause, faults_as, open_regular
from cleargs.types import AnyImage, ImageF32, ImageU8, MaskU8

_FORMATS = ["JPEG", "PNG", "WEBP", "TIFF", "BMP", "AVIF"]  # formats that are read, as Pillow names them

_HEIC = frozenset({b"heic", b"heix", b"heim", b"heis", b"hevc", b"hevx", b"mif1", b"msf1"})
"""Brands of HEIC files (ISO/IEC 23008-12)."""

_JXL = (b"\xff\x0a", b"\0\0\0\x0cJXL ")  # first bytes of JPEG XL files (ISO/IEC 18181-2)

_OPAQUE = frozenset({".jpg", ".jpeg", ".bmp"})

_METADATA = 2**18  # bytes at the start of a file that are searched for metadata

_ORIENTATION, _MODEL, _EXIF = 274, 272, 0x8769
_LENS = (42036, 37386, 41989)
"""EXIF tags: orientation, camera model, a table of further tags; in it, the lens and its focal lengths."""

_FAULTS: tuple[type[Exception], ...] = (*FAULTS, SyntaxError, Image.DecompressionBombError)
"""Errors that Pillow raises for a file of the wrong form."""

_HINT = "copy the file again, convert it to JPEG or PNG, or remove it"


def lens_name(path: Path) -> tuple[str, ...]:
    """Return camera, lens and focal lengths from the EXIF data of the image in ``path``.

    Phones have several lenses whose images are of one size. Empty if the file cannot be read.
    """
    with suppress(InputError), _opened(path) as image:
        exif = image.getexif()
        more = exif.get_ifd(_EXIF)
        return tuple(str(value) for value in (exif.get(_MODEL), *map(more.get, _LENS)))
    return ()


def is_panorama(path: Path) -> bool:
    """Return True if the metadata of the image in ``path`` say that it is equirectangular (XMP's GPano)."""
    with open_regular(path) as file:
        return b"equirectangular" in file.read(_METADATA)


def image_size(path: Path) -> tuple[int, int]:
    """Return stored width and height of the image in ``path``. Raises InputError if it cannot be read."""
    with _opened(path) as image:
        width, height = image.size
        swapped = image.format == "TIFF" and image.getexif().get(_ORIENTATION, 1) >= 5
        return (height, width) if swapped else (width, height)


def read_rgb(path: Path, *, upright: bool = True) -> ImageU8:  # [H, W, 3]
    """Return the image in ``path`` as 8-bit sRGB [H, W, 3].

    Alpha is dropped, 16 bits are reduced to 8, and an ICC profile is converted to sRGB. With ``upright``, the
    image is turned by its EXIF orientation. Raises InputError if there is no readable image, or if it has
    more than `MAX_PIXELS`.
    """
    with _decoded(path, upright=upright) as image:
        rgb = (_grey(image) if image.mode.startswith("I;16") else image).convert("RGB")
        profile = image.info.get("icc_profile")
        return np.array(_srgb_from_profile(rgb, profile) if profile else rgb)


def read_mask(path: Path) -> MaskU8:  # [H, W]
    """Return a mask [H, W]: 0 if the pixel is ignored, else 255. Raises InputError like `read_rgb`.

    The threshold is 127, or 0 for masks of 0 and 1, which some programs write.
    """
    with _decoded(path) as image:
        grey = np.asarray(_grey(image))
    border = 127 if grey.max() > 1 else 0
    return np.asarray(np.where(grey > border, 255, 0), np.uint8)


def read_alpha(path: Path, *, upright: bool = True) -> MaskU8 | None:  # [H, W]
    """Return the transparency of an image as a mask: 0 if it is more than half transparent, else 255.

    None if it is opaque everywhere. ``upright`` and errors are as in `read_rgb`.
    """
    if path.suffix.lower() in _OPAQUE:
        return None
    with _decoded(path, upright=upright) as image:
        if not image.has_transparency_data:
            return None
        opaque = np.asarray(image.convert("RGBA"))[..., 3] > 127
    return None if opaque.all() else np.asarray(np.where(opaque, 255, 0), np.uint8)


def write_rgb(path: Path, image: AnyImage, *, quality: int | None = None) -> None:
    """Write an image [H, W, 3] atomically in the format of its ending. Floats are sRGB, clipped to [0, 1].

    ``quality`` is that of a JPEG. Raises StoreError when the disk is full or not writable.
    """
    options = [] if quality is None else [cv2.IMWRITE_JPEG_QUALITY, quality]
    _, data = cv2.imencode(path.suffix, cv2.cvtColor(to_uint8(image), cv2.COLOR_RGB2BGR), options)
    write_bytes(path, data.tobytes())


def write_mask(path: Path, mask: MaskU8) -> None:  # [H, W]
    """Write a one-channel image atomically. Raises StoreError like `write_rgb`."""
    write_bytes(path, cv2.imencode(path.suffix, mask)[1].tobytes())


def to_uint8(image: AnyImage) -> ImageU8:
    """Return floats in [0, 1] (clipped) rounded to 0..255; an image of bytes stays unchanged."""
    if image.dtype == np.uint8:
        return image
    return np.asarray(np.rint(np.clip(image, 0, 1) * 255), np.uint8)


def to_float32(image: AnyImage) -> ImageF32:
    """Return an image of bytes as floats in [0, 1]; one of floats keeps its values."""
    floats = image.astype(np.float32)
    return floats / np.float32(255) if image.dtype == np.uint8 else floats


def reduced(image: AnyImage, long_side: int) -> AnyImage:  # [H, W] or [H, W, 3]
    """Return the image with a long side of at most ``long_side`` px, by area averaging."""
    width, height = reduced_size(image.shape[1], image.shape[0], long_side)
    if (height, width) == image.shape[:2]:
        return image
    return cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)


def reduced_size(width: int, height: int, long_side: int) -> tuple[int, int]:
    """Return width and height, scaled to a long side of at most ``long_side`` px."""
    scale = min(1.0, long_side / max(width, height))
    return max(1, round(width * scale)), max(1, round(height * scale))


@contextmanager
def _opened(path: Path) -> Iterator[Image.Image]:
    """Open the image in ``path`` without decoding it. Errors of the block become an InputError."""
    with faults_as(InputError, f"cannot read {path}", hint=_HINT), open_regular(path) as file:
        head = file.read(12)
    if not head:
        raise InputError(f"{path} is empty (zero bytes)", hint=_HINT)
    heic = head[4:8] == b"ftyp" and head[8:12] in _HEIC
    if heic:
        _register_heic(path)
    try:
        with warnings.catch_warnings(action="ignore"):  # about metadata that is damaged
            if head.startswith(_JXL):
                yield _jpeg_xl(path)
                return
            limit, Image.MAX_IMAGE_PIXELS = Image.MAX_IMAGE_PIXELS, None  # `MAX_PIXELS` is checked later
            try:
                opened = Image.open(path, formats=["HEIF"] if heic else _FORMATS)
            finally:
                Image.MAX_IMAGE_PIXELS = limit
            with opened:
                yield opened
    except _FAULTS as error:
        reason = "" if isinstance(error, UnidentifiedImageError) else f": {cause(error)}"
        raise InputError(f"{path} is not an image that can be read{reason}", hint=_HINT) from error


@contextmanager
def _decoded(path: Path, *, upright: bool = True) -> Iterator[Image.Image]:
    """Open the image in ``path``, turned by its EXIF orientation (``upright``) or as it is stored."""
    with _opened(path) as image:
        width, height = image.size
        if width * height > MAX_PIXELS:
            raise InputError(
                f"{path} has {width}x{height} pixels; at most {MAX_PIXELS} are read",
                hint="reduce the image: no more than ingest.max_size of its long side is used anyway",
            )
        if not upright:
            image.getexif()[_ORIENTATION] = 1
        yield ImageOps.exif_transpose(image)


def _jpeg_xl(path: Path) -> Image.Image:
    from OpenImageIO import ImageInput, geterror

    source = ImageInput.open(str(path))
    if source is None:
        raise ValueError(geterror())  # read here, else OpenImageIO prints it on stderr at the end
    spec = source.spec()
    pixels = source.read_image("uint8") if spec.width * spec.height <= MAX_PIXELS else None
    geterror()
    if pixels is None or pixels.ndim != 3:
        raise ValueError("it is damaged, or too large")
    image = Image.fromarray(pixels if pixels.shape[2] > 2 else pixels[..., 0])
    image.getexif()[_ORIENTATION] = spec.get_int_attribute("Orientation", 1)
    profile = spec.getattribute("ICCProfile")
    if profile is not None:
        image.info["icc_profile"] = bytes(profile)
    return image


def _register_heic(path: Path) -> None:
    try:
        import pillow_heif
    except ImportError as error:
        raise InputError(
            f"{path} is a HEIC image, which needs the package pillow-heif",
            hint="pip install 'cleargs[heif]', or convert the images to JPEG",
        ) from error
    pillow_heif.register_heif_opener()


def _grey(image: Image.Image) -> Image.Image:
    """Return the image as 8-bit grey; Pillow would clip 16-bit values to 255."""
    if image.mode.startswith("I;16"):
        return Image.fromarray((np.asarray(image) >> 8).astype(np.uint8))
    return image.convert("L")


def _srgb_from_profile(rgb: Image.Image, profile: bytes) -> Image.Image:
    """Return ``rgb`` converted from its ICC ``profile`` to sRGB, relative colorimetric.

    The image is not changed if the profile is that of sRGB, is not for RGB, or is damaged.
    """
    with suppress(ImageCms.PyCMSError, *_FAULTS):
        source = ImageCms.getOpenProfile(io.BytesIO(profile))
        if "srgb" in ImageCms.getProfileDescription(source).lower():
            return rgb
        if source.profile.xcolor_space.strip() == "RGB":
            srgb, how = ImageCms.createProfile("sRGB"), ImageCms.Intent.RELATIVE_COLORIMETRIC
            return ImageCms.profileToProfile(rgb, source, srgb, renderingIntent=how) or rgb
    return rgb
