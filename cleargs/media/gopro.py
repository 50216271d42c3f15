"""Gravity in a video of a GoPro (HERO8 and later, Max), from its GPMF track.

GPMF is a tree of items: a key of four letters, a type, the size of a sample, the number of samples, and the
samples, big-endian and padded to four bytes (https://github.com/gopro/gpmf-parser). ``GRAV`` is the direction
of gravity in the axes of the camera (x right, y down, z ahead): 0.05, 0.99, 0.13 in the sample
``max-heromode.mp4``, a walk whose camera looks down a little. ``IORI`` is the turn of the picture against the
camera, a quaternion.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from pathlib import Path

import av
import numpy as np
from numpy.typing import NDArray

from cleargs.types import ArrayF64

_HANDLER = "GoPro MET"
_DEPTH = 3  # levels of the tree: device, stream, samples
_TURNED = 0.92
"""Real part of a turn of the picture by 45 degrees. A picture that is turned more stands by its own top."""


def gravity(path: Path, pts: Sequence[int]) -> ArrayF64 | None:  # [P, 3]
    """Return the direction of gravity, in camera axes, at the frames ``pts`` of a video.

    None if the file has none or cannot be read, and if its pictures are turned.
    """
    times, found = [np.zeros(0)], [np.zeros((0, 3))]
    try:
        with av.open(path, metadata_errors="replace") as container:
            tracks = [s for s in container.streams.data if _HANDLER in s.metadata.get("handler_name", "")]
            videos = container.streams.video
            if not tracks or not videos or videos[0].time_base is None:
                return None
            for packet in container.demux(tracks[0]):
                if packet.pts is None or packet.time_base is None:
                    continue
                items = dict(_leaves(bytes(packet)))
                ways, turns = items.get(b"GRAV", np.zeros((0, 3))), items.get(b"IORI", np.ones((1, 4)))
                lengths = np.linalg.norm(ways, axis=1)
                if not len(ways) or not lengths.all() or np.median(np.abs(turns[:, 0])) < _TURNED:
                    continue
                share = (np.arange(len(ways)) + 0.5) / len(ways)
                times.append(float(packet.time_base) * (packet.pts + share * (packet.duration or 0)))
                found.append(ways / lengths[:, None])
            asked = float(videos[0].time_base) * np.array(pts, np.float64)
        with av.open(path, metadata_errors="replace") as container:
            if next(container.decode(video=0)).rotation:
                return None
    except (av.error.FFmpegError, OSError, ValueError, StopIteration):
        return None
    known = np.concatenate(times)
    if not len(known):
        return None
    nearest = np.abs(known - asked[:, None]).argmin(axis=1)
    return np.asarray(np.concatenate(found)[nearest])


def _leaves(data: bytes, depth: int = _DEPTH) -> Iterator[tuple[bytes, NDArray[np.float64]]]:
    """Yield key and samples [N, 3 or 4] of gravity and of the picture's turn, in a tree of items."""
    place, scale = 0, 1.0
    while place + 8 <= len(data):
        key, kind, size, count = struct.unpack(">4scBH", data[place : place + 8])
        body = data[place + 8 : place + 8 + size * count]
        place += 8 + (size * count + 3) // 4 * 4
        if kind == b"\0":
            yield from _leaves(body, depth - 1) if depth else ()
        elif key == b"SCAL" and kind == b"s" and len(body) >= 2:
            scale = float(np.frombuffer(body, ">i2")[0]) or 1.0
        elif key in (b"GRAV", b"IORI") and kind == b"s" and size == (6 if key == b"GRAV" else 8):
            yield key, np.frombuffer(body, ">i2").reshape(-1, size // 2) / scale
