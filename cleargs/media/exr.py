"""EXR files of several named RGB layers: scene-linear, Rec.709 primaries, half floats, zip.

Layer ``render`` is the channels ``render.R``, ``render.G``, ``render.B``. OpenEXR stores channels in
alphabetical order, so they are found by name. One of the layers may be stored again as the plain channels R,
G, B for programs that do not support layers. Equal layers and attributes give equal bytes, without a date.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray
from OpenImageIO import FLOAT, HALF, ImageInput, ImageOutput, ImageSpec, geterror

from cleargs.errors import StoreError
from cleargs.files import atomic_path
from cleargs.media import MAX_PIXELS
from cleargs.media.colour import linear_from_srgb, srgb_from_linear
from cleargs.safe_io import cause, faults_as, open_regular
from cleargs.types import ImageF32, PlaneF32

Layer: TypeAlias = NDArray[np.float16]  # [H, W, 3] scene-linear Rec.709
Attribute: TypeAlias = int | float | str

_CHANNELS = "RGB"
_MAX_CHANNELS = 64  # most channels of a file that is read; ours have six layers of three


@dataclass(frozen=True, eq=False)
class LayeredImage:
    """Content of an EXR: layers by name, and the attributes of its writer (floats in single precision)."""

    layers: Mapping[str, Layer]
    attributes: Mapping[str, Attribute]


def to_layer(image: ImageF32) -> Layer:
    """Return the stored form of an sRGB image [H, W, 3]."""
    return linear_from_srgb(image).astype(np.float16)


def from_layer(layer: Layer) -> ImageF32:
    """Return the sRGB image [H, W, 3] of a stored layer."""
    return srgb_from_linear(layer.astype(np.float32))


def write_exr(path: Path, image: LayeredImage, *, shown: str | None = None) -> None:
    """Write the layers (all of one size) and attributes to ``path``, atomically.

    The layer ``shown`` is also written as the plain channels R, G, B. Raises StoreError if the disk is full
    or not writable.
    """
    layers = {f"{name}.": layer for name, layer in image.layers.items()}
    if shown is not None:
        layers = {"": image.layers[shown], **layers}
    channels = {f"{prefix}{letter}": HALF for prefix in layers for letter in _CHANNELS}
    _write(path, np.concatenate(list(layers.values()), axis=2), channels, image.attributes)


def write_view(path: Path, image: ImageF32, alpha: PlaneF32, depth: PlaneF32) -> None:
    """Write one image over black as the channels R, G, B, A (half) and Z (float), atomically.

    ``depth`` is along the optical axis. Raises StoreError if the disk is full or not writable.
    """
    layer = to_layer(image).astype(np.float32)
    _write(path, np.dstack([layer, alpha, depth]), dict.fromkeys("RGBA", HALF) | {"Z": FLOAT}, {})


def write_depth(path: Path, depth: NDArray[Any]) -> None:  # [H, W]
    """Write one float channel Z, atomically. Raises StoreError if the disk is full or not writable."""
    _write(path, np.asarray(depth[..., None], np.float32), {"Z": FLOAT}, {})


def read_depth(path: Path) -> PlaneF32:
    """Read the file of `write_depth`. Raises StoreError if it is missing, damaged, or has other channels."""
    with faults_as(StoreError, f"cannot read {path.name}", hint="delete the file"):
        spec, pixels = _read(path, FLOAT)
        if spec.channelnames != ("Z",):
            raise ValueError(f"its channels are {spec.channelnames}, not Z alone")
    return np.ascontiguousarray(pixels[..., 0])


def _read(path: Path, form: Any) -> tuple[ImageSpec, NDArray[Any]]:
    """Return the header of a file and its pixels [H, W, C] as numbers of ``form``.

    Raises one of `FAULTS` if the file is missing, damaged or too large.
    """
    open_regular(path).close()
    source = ImageInput.open(str(path))
    if source is None:
        raise ValueError(geterror().strip())
    spec = source.spec()
    if spec.width * spec.height > MAX_PIXELS or spec.nchannels > _MAX_CHANNELS:
        raise ValueError(f"{spec.width}x{spec.height} pixels of {spec.nchannels} channels are too many")
    pixels = source.read_image(form)
    if pixels is None:
        raise ValueError(source.geterror().strip())
    return spec, np.asarray(pixels)


def _write(
    path: Path, pixels: NDArray[Any], channels: Mapping[str, Any], attributes: Mapping[str, Attribute]
) -> None:
    """Write ``pixels`` [H, W, C]; ``channels`` are their names, each with its format in the file."""
    height, width, count = pixels.shape
    spec = ImageSpec(width, height, count, next(iter(channels.values())))
    spec.channelnames, spec.channelformats = tuple(channels), tuple(channels.values())
    spec.attribute("compression", "zip")
    if count > 1:  # depth alone has no colour
        spec.attribute("oiio:ColorSpace", "lin_rec709")
    spec.attribute("DateTime", "")  # OpenImageIO writes the present time unless this is set
    for name, value in attributes.items():
        spec.attribute(name, value)
    with atomic_path(path) as temporary:
        output = ImageOutput.create(str(temporary))
        if not (
            output and output.open(str(temporary), spec) and output.write_image(pixels) and output.close()
        ):
            reason = cause(ValueError((output.geterror() if output else geterror()).strip()))
            raise StoreError(
                f"cannot write {path.name}: {reason}",
                hint="check the free space and the permissions of the run folder",
            )


def read_exr(path: Path, prefix: str = "") -> LayeredImage:
    """Read every named RGB layer of ``path``, and the attributes whose name begins with ``prefix``.

    Raises StoreError if the file is missing, damaged, or has a channel outside an RGB layer.
    """
    # OpenImageIO's messages may contain bytes of the file that are not text.
    with faults_as(StoreError, f"cannot read {path.name}", hint="delete the file and run its stage again"):
        spec, pixels = _read(path, HALF)
        place = {name: k for k, name in enumerate(spec.channelnames)}
        # The plain channels R, G, B are a copy of one of the layers.
        names = dict.fromkeys(name.rpartition(".")[0] for name in place if name not in _CHANNELS)
        layers = {
            name: np.ascontiguousarray(pixels[..., [place[f"{name}.{channel}"] for channel in _CHANNELS]])
            for name in names
        }
        kept: dict[str, Any] = {
            item.name: item.value for item in spec.extra_attribs if item.name.startswith(prefix)
        }
    return LayeredImage(layers, kept)
