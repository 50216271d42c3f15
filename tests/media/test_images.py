"""Image files that cannot be, or that would take all memory."""

from __future__ import annotations

import os
import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from OpenImageIO import ImageOutput, ImageSpec
from PIL import Image

from cleargs.errors import InputError
from cleargs.media import MAX_PIXELS
from cleargs.media.image import image_size, read_alpha, read_mask, read_rgb

PNG = b"\x89PNG\r\n\x1a\n"


def chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def bomb(side: int) -> bytes:
    """A small PNG of a huge size."""
    header = struct.pack(">IIBBBBB", side, side, 8, 0, 0, 0, 0)
    rows = zlib.compress(bytes(64 * (side + 1)), 9)
    return PNG + chunk(b"IHDR", header) + chunk(b"IDAT", rows) + chunk(b"IEND", b"")


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".webp", ".tif", ".bmp"])
@pytest.mark.parametrize("shape", [(3, 5, 3), (300, 200), (1, 1, 3)])
def test_size_from_header(tmp_path: Path, suffix: str, shape: tuple[int, ...]) -> None:
    path = tmp_path / f"a{suffix}"
    assert cv2.imwrite(str(path), np.full(shape, 7, np.uint8))
    assert image_size(path) == (shape[1], shape[0])
    path.rename(tmp_path / "named-otherwise.png")
    assert image_size(tmp_path / "named-otherwise.png") == (shape[1], shape[0])


@pytest.mark.parametrize(
    ("suffix", "flags"),
    [
        (".jpg", [cv2.IMWRITE_JPEG_PROGRESSIVE, 1]),
        (".jpg", [cv2.IMWRITE_JPEG_RST_INTERVAL, 2]),
        (".webp", [cv2.IMWRITE_WEBP_QUALITY, 50]),
    ],
)
def test_size_of_other_codings(tmp_path: Path, suffix: str, flags: list[int]) -> None:
    path = tmp_path / f"a{suffix}"
    assert cv2.imwrite(str(path), np.zeros((40, 60, 3), np.uint8), flags)
    assert image_size(path) == (60, 40)


def test_other_formats_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.png"
    path.write_bytes(b"P6 1 1 255 abc")  # OpenCV and OpenImageIO read it
    with pytest.raises(InputError, match="not an image that can be read"):
        read_rgb(path)


def test_an_image_bomb_is_refused_before_it_is_decoded(tmp_path: Path) -> None:
    path = tmp_path / "small.png"
    path.write_bytes(bomb(32_000))
    assert path.stat().st_size < 2**20
    with pytest.raises(InputError, match=f"32000x32000 pixels; at most {MAX_PIXELS}"):
        read_rgb(path)
    with pytest.raises(InputError, match="32000x32000"):
        read_mask(path)


@pytest.mark.parametrize("what", ["fifo", "device", "folder", "nothing"])
def test_only_regular_files_are_images(tmp_path: Path, what: str) -> None:
    path = tmp_path / "x.png"
    if what == "fifo":
        os.mkfifo(path)
    elif what == "device":
        path.symlink_to("/dev/zero")
    elif what == "folder":
        path.mkdir()
    with pytest.raises(InputError, match="cannot read"):
        read_rgb(path)


def test_a_link_to_an_image_is_an_image(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "a.png"), np.zeros((4, 6, 3), np.uint8))
    (tmp_path / "b.png").symlink_to("a.png")
    assert read_rgb(tmp_path / "b.png").shape == (4, 6, 3)


def test_a_mask_of_zeros_and_ones(tmp_path: Path) -> None:
    """As segmentation programs write them."""
    labels = np.eye(4, dtype=np.uint8)
    cv2.imwrite(str(tmp_path / "mask.png"), labels)
    assert np.array_equal(read_mask(tmp_path / "mask.png"), labels * 255)
    faint = 3 * labels  # black except for a codec's noise
    cv2.imwrite(str(tmp_path / "faint.png"), faint)
    assert not read_mask(tmp_path / "faint.png").any()
    cv2.imwrite(str(tmp_path / "nothing.png"), 0 * labels)
    assert not read_mask(tmp_path / "nothing.png").any()


@pytest.mark.parametrize("kind", ["png", "tif"])
@pytest.mark.parametrize("orientation", range(1, 10))
def test_an_image_turns_with_its_transparency_or_stays(tmp_path: Path, orientation: int, kind: str) -> None:
    """OpenCV turns a TIFF even where it is to be read as it is stored."""
    opaque = np.random.default_rng(orientation).integers(0, 2, (4, 6, 1), np.uint8) * 255
    spec = ImageSpec(6, 4, 4, "uint8")
    spec.attribute("Orientation", orientation)
    path = tmp_path / f"cut.{kind}"
    output = ImageOutput.create(str(path))
    assert output.open(str(path), spec) and output.write_image(np.repeat(opaque, 4, axis=2))
    output.close()
    for upright in (True, False):
        alpha = read_alpha(path, upright=upright)
        assert alpha is not None and np.array_equal(alpha, read_rgb(path, upright=upright)[..., 0])
    assert np.array_equal(read_rgb(path, upright=False)[..., :1], opaque)


def rgba(grey: object, alpha: object) -> Image.Image:
    return Image.fromarray(
        np.dstack([np.broadcast_to(x, (4, 6)) for x in (grey, grey, grey, alpha)]).astype(np.uint8)
    )


LEFT = np.arange(6) < 3
"""True in the left half."""


@pytest.mark.parametrize(
    ("grey", "alpha"),
    [
        (255, 255 * LEFT),  # white with the mask in its alpha
        (0, 255 * LEFT),
        (255 * LEFT, 255 * LEFT),  # white on nothing
        (np.arange(24).reshape(4, 6) * 8 + 40, 255 * LEFT),  # a cut-out of the photograph
        (255 * LEFT, 255),  # grey, with an alpha that says nothing
        (255 * LEFT, 254),
        (255 * LEFT, 255 * (np.arange(6) > 0)),  # its alpha is not the mask
        (np.where(LEFT, 255, 0), np.where(LEFT, 0, 255)),  # black paint on nothing
    ],
)
def test_a_mask_in_alpha_or_in_grey(tmp_path: Path, grey: object, alpha: object) -> None:
    rgba(grey, alpha).save(tmp_path / "mask.png")
    assert np.array_equal(read_mask(tmp_path / "mask.png") > 0, np.broadcast_to(LEFT, (4, 6)))
