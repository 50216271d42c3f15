"""The size that an image file states in its first bytes: what decoding takes is known before."""

from __future__ import annotations

import struct

PNG = b"\x89PNG\r\n\x1a\n"

_JPEG_ALONE = frozenset({0x01, *range(0xD0, 0xD9)})
"""JPEG markers without a segment."""

_JPEG_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
"""JPEG markers of the segment that states the size."""

_JPEG_HEAD = 2**24
"""Bytes within which a JPEG states its size: what a camera notes before takes far less."""

_TIFF_WIDTH, _TIFF_HEIGHT = 256, 257


def image_size(data: bytes) -> tuple[int, int] | None:
    """Width and height that a JPEG, PNG, WebP, TIFF or BMP states; None for anything else."""
    try:
        if data.startswith(PNG):
            return _unpack(">II", data, 16)
        if data.startswith(b"\xff\xd8"):
            return _jpeg(data[:_JPEG_HEAD])
        if data[:4] == b"RIFF" and data[8:12] == b"WEBP":
            return _webp(data)
        if data[:4] in (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+"):
            return _tiff(data)
        if data.startswith(b"BM"):
            width, height = _unpack("<HH" if data[14] == 12 else "<ii", data, 18)
            return abs(width), abs(height)  # a negative height: rows from the top
    except (struct.error, IndexError):
        pass
    return None


def _unpack(layout: str, data: bytes, at: int) -> tuple[int, int]:
    first, second = struct.unpack_from(layout, data, at)
    return int(first), int(second)


def _jpeg(data: bytes) -> tuple[int, int] | None:
    """The first frame header (ITU T.81, annex B)."""
    at = 2
    while True:
        while data[at] != 0xFF or data[at + 1] in (0x00, 0xFF):
            at += 1
        marker = data[at + 1]
        if marker in _JPEG_FRAMES:
            height, width = _unpack(">HH", data, at + 5)
            return width, height
        at += 2 if marker in _JPEG_ALONE else 2 + max(2, int.from_bytes(data[at + 2 : at + 4], "big"))


def _webp(data: bytes) -> tuple[int, int] | None:
    """The size in the first chunk, which is of one of three kinds."""
    kind = data[12:16]
    if kind == b"VP8X":
        return 1 + int.from_bytes(data[24:27], "little"), 1 + int.from_bytes(data[27:30], "little")
    if kind == b"VP8 ":
        width, height = _unpack("<HH", data, 26)
        return width & 0x3FFF, height & 0x3FFF
    if kind == b"VP8L":
        (bits,) = struct.unpack_from("<I", data, 21)
        return 1 + (bits & 0x3FFF), 1 + (bits >> 14 & 0x3FFF)
    return None


def _tiff(data: bytes) -> tuple[int, int] | None:
    """Tags of the first directory, also of a BigTIFF."""
    order = "<" if data[:2] == b"II" else ">"
    big = b"+" in data[:4]
    (start,) = struct.unpack_from(f"{order}{'Q' if big else 'I'}", data, 8 if big else 4)
    (count,) = struct.unpack_from(f"{order}{'Q' if big else 'H'}", data, start)
    sizes = {}
    for entry in range(min(count, 65_535)):
        at = start + (8 + 20 * entry if big else 2 + 12 * entry)
        tag, kind = struct.unpack_from(f"{order}HH", data, at)
        if tag in (_TIFF_WIDTH, _TIFF_HEIGHT):
            value = {3: "H", 4: "I", 16: "Q"}.get(kind)
            if value is None:
                return None
            (sizes[tag],) = struct.unpack_from(f"{order}{value}", data, at + (12 if big else 8))
    if len(sizes) < 2:
        return None
    return sizes[_TIFF_WIDTH], sizes[_TIFF_HEIGHT]
