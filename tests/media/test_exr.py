"""Layered EXR files: exact halves, channels by name, equal bytes for equal content."""

from __future__ import annotations

from pathlib import Path

import av
import numpy as np
import pytest
from OpenImageIO import HALF, ImageBuf, ImageInput

from cleargs.errors import StoreError
from cleargs.media.exr import LayeredImage, from_layer, read_depth, read_exr, to_layer, write_depth, write_exr

NAMES = ("render", "restored", "fused", "observed")


def layered(seed: int = 0) -> LayeredImage:
    """Four different layers with negative values and values far above 1."""
    rng = np.random.default_rng(seed)
    layers = {name: rng.normal(0.5, 3.0, (17, 23, 3)).astype(np.float16) for name in NAMES}
    attributes = {"cleargs:frame": 7, "cleargs:chosen": "fused", "cleargs:primary_render": 71.25}
    return LayeredImage(layers, attributes)


def test_round_trip_is_exact(tmp_path: Path) -> None:
    image = layered()
    assert min(layer.min() for layer in image.layers.values()) < 0
    assert max(layer.max() for layer in image.layers.values()) > 1
    write_exr(tmp_path / "a.exr", image)
    back = read_exr(tmp_path / "a.exr", "cleargs:")
    assert set(back.layers) == set(NAMES)
    for name in NAMES:
        np.testing.assert_array_equal(back.layers[name], image.layers[name])
    assert dict(back.attributes) == dict(image.attributes)
    assert [path.name for path in tmp_path.iterdir()] == ["a.exr"]


def test_other_readers_find_half_channels_by_name(tmp_path: Path) -> None:
    image = layered()
    write_exr(tmp_path / "a.exr", image)
    source = ImageInput.open(str(tmp_path / "a.exr"))
    spec = source.spec()
    assert spec.format == HALF
    assert spec.get_string_attribute("compression") == "zip"
    pixels = source.read_image(HALF)
    source.close()
    assert list(spec.channelnames) != [f"{name}.{c}" for name in NAMES for c in "RGB"]  # sorted by OpenEXR
    green = pixels[..., spec.channelnames.index("restored.G")]
    np.testing.assert_array_equal(green, image.layers["restored"][..., 1])


def test_the_shown_layer_is_what_programs_without_layers_find(tmp_path: Path) -> None:
    image = layered()
    write_exr(tmp_path / "a.exr", image, shown="fused")
    write_exr(tmp_path / "b.exr", image, shown="fused")
    assert (tmp_path / "a.exr").read_bytes() == (tmp_path / "b.exr").read_bytes()
    source = ImageInput.open(str(tmp_path / "a.exr"))
    names, pixels = list(source.spec().channelnames), source.read_image(HALF)
    source.close()
    for channel in range(3):
        plain = pixels[..., names.index("RGB"[channel])]
        np.testing.assert_array_equal(plain, image.layers["fused"][..., channel])
    back = read_exr(tmp_path / "a.exr", "cleargs:")
    assert set(back.layers) == set(NAMES), "the plain channels are no layer of their own"
    for name in NAMES:
        np.testing.assert_array_equal(back.layers[name], image.layers[name])


def test_ordinary_programs_open_the_shown_layer(tmp_path: Path) -> None:
    """FFmpeg, which knows R, G and B by name, and those that take the first three channels of a file."""
    layers = {
        name: np.full((16, 24, 3), value, np.float16) * np.array([1.0, 0.5, 0.25], np.float16)
        for name, value in (("fused", 0.5), ("observed", 0.125), ("render", 1.0))
    }
    path = tmp_path / "a.exr"
    write_exr(path, LayeredImage(layers, {}), shown="observed")
    with av.open(str(path)) as container:
        planes = next(container.decode(video=0)).planes
        green, blue, red = (float(np.frombuffer(bytes(plane), np.float16)[0]) for plane in planes)
    assert (red, green, blue) == (0.125, 0.0625, 0.03125)
    buffer = ImageBuf(str(path))
    assert buffer.spec().channelnames[:3] == ("R", "G", "B") and buffer.nsubimages == 1
    assert tuple(buffer.getpixel(3, 3)[:3]) == (0.125, 0.0625, 0.03125)


def test_equal_content_gives_equal_bytes_and_no_date(tmp_path: Path) -> None:
    write_exr(tmp_path / "a.exr", layered())
    write_exr(tmp_path / "b.exr", layered())
    write_exr(tmp_path / "c.exr", layered(seed=1))
    a, b, c = ((tmp_path / f"{name}.exr").read_bytes() for name in "abc")
    assert a == b != c
    assert not read_exr(tmp_path / "a.exr").attributes.get("DateTime")


def test_stored_form_is_stable() -> None:
    """Every half in [0, 1] survives the way to sRGB and back: to store what was read changes nothing."""
    halves = np.arange(2**16, dtype=np.uint16).view(np.float16)
    halves = halves[(halves >= 0) & (halves <= 1)]
    np.testing.assert_array_equal(to_layer(from_layer(halves)), halves)


def test_srgb_survives_within_a_tenth_of_an_8_bit_level() -> None:
    """Half floats have 11 significant bits; in sRGB that is at most 1 / 2^12, a sixteenth of a level."""
    image = np.linspace(0, 1, 3 * 4096, dtype=np.float32).reshape(64, 64, 3)
    assert np.abs(from_layer(to_layer(image)) - image).max() < 0.1 / 255


@pytest.mark.parametrize("content", [b"", b"no image", None])
def test_damaged_files_are_store_errors(tmp_path: Path, content: bytes | None) -> None:
    path = tmp_path / "a.exr"
    if content is None:
        write_exr(path, layered())
        content = path.read_bytes()[:2000]
    path.write_bytes(content)
    with pytest.raises(StoreError):
        read_exr(path)


@pytest.mark.parametrize("content", [b"", b"no image", "layers", "cut", None])
def test_a_damaged_depth_is_a_store_error(tmp_path: Path, content: bytes | str | None) -> None:
    path, depth = tmp_path / "depth.exr", np.linspace(1, 3, 64 * 48, dtype=np.float32).reshape(48, 64)
    write_depth(path, depth)
    np.testing.assert_array_equal(read_depth(path), depth)
    if content == "layers":
        write_exr(path, layered())
    elif content == "cut":
        path.write_bytes(path.read_bytes()[:1000])
    elif content is None:
        path.unlink()
    else:
        path.write_bytes(content)
    with pytest.raises(StoreError):
        read_depth(path)


def test_unwritable_place_is_a_store_error(tmp_path: Path) -> None:
    with pytest.raises(StoreError):
        write_exr(tmp_path / "missing" / "a.exr", layered())
