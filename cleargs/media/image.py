"""Still images as 8-bit sRGB arrays, through Pillow; JPEG XL through OpenImageIO."""

from __future__ import annotations

import io
import math
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
from cleargs.media.colour import TRANSFERS, srgb_from_hdr
from cleargs.safe_io import FAULTS, cause, faults_as, open_regular
from cleargs.types import AnyImage, ImageF32, ImageU8, MaskU8

_FORMATS = ["JPEG", "PNG", "WEBP", "TIFF", "BMP", "AVIF"]  # formats that are read, as Pillow names them

_HEIC = frozenset({b"heic", b"heix", b"heim", b"heis", b"hevc", b"hevx", b"mif1", b"msf1"})
"""Brands of HEIC files (ISO/IEC 23008-12)."""

_JXL = (b"\xff\x0a", b"\0\0\0\x0cJXL ")  # first bytes of JPEG XL files (ISO/IEC 18181-2)

_OPAQUE = frozenset({".jpg", ".jpeg", ".bmp"})

_NCLX = b"colrnclx"  # in HEIC and AVIF files, before the codes of primaries and transfer (ISO/IEC 14496-12)

_METADATA = 2**18  # bytes at the start of a file that are searched for metadata

_ORIENTATION, _MODEL, _EXIF = 274, 272, 0x8769
_FOCAL_MM, _FOCAL_35MM = 37386, 41989
_LENS = (42036, _FOCAL_MM, _FOCAL_35MM)
"""EXIF tags: orientation, camera model, a table of further tags; in it, the lens and its focal lengths."""

_PLANE, _PLANE_UNIT, _SIDES = 41486, 41488, (40962, 40963)
"""EXIF tags: pixels per unit on the sensor, that unit, and the size of the picture before it was reduced."""
_UNIT_MM = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}

_DIAGONAL_MM = 43.27  # diagonal of 35 mm film, as COLMAP rounds it
_LONGEST = 4.0
"""Longest focal length by the sensor, in long sides of the picture (144 mm on 35 mm film). Programs that
reduce pictures and renew their EXIF size only in part state longer ones."""

_DARK, _PHOTOGRAPH = 16, 0.1
"""A picture counts as a photograph, not as a mask, if more than this share of it is neither nearly black nor
nearly white."""

_SAME = 2  # levels by which a profile may differ from sRGB and still count as sRGB: rounding, other curves

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


def stated_focal(path: Path) -> float | None:
    """Return the focal length in the EXIF data of the image in ``path``, in long sides of the picture.

    It is the equivalent on 35 mm film, else that of the sensor, which needs the size that the camera gave the
    picture: it may have been reduced. None if it is missing, damaged, or none that a camera has.
    """
    with suppress(InputError, *FAULTS), _opened(path) as image:
        tags = image.getexif().get_ifd(_EXIF)
        if (film := float(tags.get(_FOCAL_35MM) or 0)) > 0:
            return film / _DIAGONAL_MM * math.hypot(*image.size) / max(image.size)
        focal_px = float(tags[_FOCAL_MM]) / _UNIT_MM[tags.get(_PLANE_UNIT, 2)] * float(tags[_PLANE])
        share = focal_px / max(float(tags[side]) for side in _SIDES)
        return share if 0 < share <= _LONGEST else None
    return None


def orientation(path: Path) -> int:
    """Return the EXIF orientation of the image in ``path``, 1 to 8; 1 if it is not turned."""
    with _opened(path) as image:
        turn = image.getexif().get(_ORIENTATION, 1)
        return turn if turn in range(1, 9) else 1


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

    Alpha is dropped, 16 bits are reduced to 8, an ICC profile is converted to sRGB, and HDR is tone-mapped.
    With ``upright``, the image is turned by its EXIF orientation. Raises InputError if there is no readable
    image, if it holds other numbers than colours, or if it has more than `MAX_PIXELS`.
    """
    with _decoded(path, upright=upright) as image:
        if image.mode in ("F", "I"):
            raise InputError(
                f"{path} holds measured numbers, not colours",
                hint="export it from its program as a PNG or TIFF of 8 or 16 bits",
            )
        eight = _grey(image) if image.mode.startswith("I;16") else image
        profile = image.info.get("icc_profile")
        made = _srgb_from_profile(eight, profile) if profile else None
        rgb = np.array(eight.convert("RGB") if made is None else made)
        transfer = None if profile else _hdr_transfer(path, image)
        return rgb if transfer is None else to_uint8(srgb_from_hdr(to_float32(rgb), transfer))


def read_mask(path: Path, turn: int = 1) -> MaskU8:  # [H, W]
    """Return a mask [H, W]: 0 if the pixel is ignored, else 255. Raises InputError like `read_rgb`.

    The threshold is 127, or 0 for masks of 0 and 1, which some programs write. If a picture has transparent
    parts, and its other pixels are all bright or are a photograph, its alpha is the mask. ``turn`` is an EXIF
    orientation by which the mask is turned.
    """
    with _decoded(path) as image:
        image.getexif()[_ORIENTATION] = turn
        turned = ImageOps.exif_transpose(image)
        grey = np.asarray(_grey(turned))
        if turned.has_transparency_data:
            alpha = np.asarray(turned.convert("RGBA"))[..., 3]
            seen = grey[alpha > 127]
            between = ((seen > _DARK) & (seen < 255 - _DARK)).mean() if seen.size else 0.0
            if seen.size < grey.size and (
                np.ptp(grey) == 0 or seen.min(initial=255) > 127 or between > _PHOTOGRAPH
            ):
                grey = alpha
    border = 127 if grey.max() > 1 else 0
    return np.asarray(np.where(grey > border, 255, 0), np.uint8)


def read_grey(path: Path) -> MaskU8:  # [H, W]
    """Return the levels of a one-channel image. Raises InputError if it cannot be read."""
    with _decoded(path) as image:
        return np.array(image.convert("L"))


def read_alpha(path: Path, *, upright: bool = True) -> MaskU8 | None:  # [H, W]
    """Return the transparency of an image as a mask: 0 if it is more than half transparent, else 255.

    None if it is opaque everywhere. ``upright`` and errors are as in `read_rgb`.
    """
    alpha = read_transparency(path, upright=upright)
    return None if alpha is None else np.asarray(np.where(alpha > 127, 255, 0), np.uint8)


def read_transparency(path: Path, *, upright: bool = True) -> MaskU8 | None:  # [H, W]
    """Return the alpha of an image, 0 (transparent) to 255; None if no pixel is more than half transparent.

    ``upright`` and errors are as in `read_rgb`.
    """
    if path.suffix.lower() in _OPAQUE:
        return None
    with _decoded(path, upright=upright) as image:
        if not image.has_transparency_data:
            return None
        alpha = np.asarray(image.convert("RGBA"))[..., 3]
    return None if (alpha > 127).all() else alpha


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


def _hdr_transfer(path: Path, image: Image.Image) -> str | None:
    """Return ``pq`` or ``hlg`` for a HEIC or AVIF picture of HDR, else None.

    Pillow does not read the colours of an AVIF file. A file with a map of gains has those of its HDR version
    too, but its picture is that for usual displays.
    """
    code = (image.info.get("nclx_profile") or {}).get("transfer_characteristics")
    if path.suffix.lower() in (".avif", ".avifs"):
        with open_regular(path) as file:
            head = file.read(_METADATA)
        place = -1 if b"tmap" in head else head.find(_NCLX)
        code = int.from_bytes(head[place + len(_NCLX) + 2 :][:2], "big") if place >= 0 else None
    return TRANSFERS.get(code or 0)


def _srgb_from_profile(image: Image.Image, profile: bytes) -> Image.Image | None:
    """Return ``image`` converted from its ICC ``profile`` to sRGB, relative colorimetric.

    None if the profile is that of sRGB by its content (names mislead), is for another kind of pixels, or is
    damaged.
    """
    with suppress(ImageCms.PyCMSError, *_FAULTS):
        source = ImageCms.getOpenProfile(io.BytesIO(profile))
        mode = {"RGB": "RGB", "GRAY": "L", "CMYK": "CMYK"}[source.profile.xcolor_space.strip()]
        if mode != "RGB" and image.mode != mode:
            return None
        srgb, how = ImageCms.createProfile("sRGB"), ImageCms.Intent.RELATIVE_COLORIMETRIC
        convert = ImageCms.buildTransform(source, srgb, mode, "RGB", renderingIntent=how)
        if mode == "RGB":
            levels = np.linspace(0, 255, 9).astype(np.uint8)
            grid = np.stack(np.meshgrid(levels, levels, levels), axis=-1).reshape(9, 81, 3)
            made = np.asarray(ImageCms.applyTransform(Image.fromarray(grid), convert), np.int16)
            if np.abs(made - grid).max() <= _SAME:
                return None
        return ImageCms.applyTransform(image.convert(mode), convert)
    return None
