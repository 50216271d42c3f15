"""Gravity in the GPMF track of a GoPro's video."""

from __future__ import annotations

import struct
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest

from cleargs.media.gopro import gravity


def item(key: bytes, kind: bytes, size: int, count: int, body: bytes) -> bytes:
    return struct.pack(">4scBH", key, kind, size, count) + body + bytes(-len(body) % 4)


def tree(*streams: bytes) -> bytes:
    inside = b"".join(item(b"STRM", b"\0", 1, len(stream), stream) for stream in streams)
    return item(b"DEVC", b"\0", 1, len(inside), inside)


def samples(key: bytes, rows: list[list[float]]) -> bytes:
    values = np.round(32767 * np.array(rows)).astype(">i2")
    scale = item(b"SCAL", b"s", 2, 1, struct.pack(">h", 32767))
    return scale + item(key, b"s", 2 * values.shape[1], len(values), values.tobytes())


def write(path: Path, payloads: list[bytes], handler: str = "GoPro MET") -> Path:
    """Write a video of 1 s at 30 frames per second, with a payload per half second."""
    with av.open(path, "w") as container:
        video = container.add_stream("libx264", rate=30)
        video.width, video.height = 64, 48
        track = container.add_data_stream("bin_data")
        track.metadata["handler_name"] = handler
        for number, payload in enumerate(payloads):
            packet = av.Packet(payload)
            packet.stream, packet.time_base = track, Fraction(1, 1000)
            packet.pts = packet.dts = 500 * number
            packet.duration = 500
            container.mux(packet)
        for number in range(30):
            frame = av.VideoFrame.from_ndarray(np.full((48, 64, 3), number, np.uint8), format="rgb24")
            container.mux(video.encode(frame))
        container.mux(video.encode())
    return path


def test_gravity_is_read_at_the_frames(tmp_path: Path) -> None:
    level, rolled = [0.0, 1.0, 0.0], [0.995, 0.0995, 0.0]
    straight, turned = [[1.0, 0, 0, 0]] * 3, [[0.0, 0, 0, 1.0]] * 3
    halves = [tree(samples(b"IORI", straight), samples(b"GRAV", [way] * 3)) for way in (level, rolled)]
    video = write(tmp_path / "a.mp4", halves)
    with av.open(video) as opened:
        base = opened.streams.video[0].time_base
        assert base is not None
        pts = [round(second / base) for second in (0.1, 0.3, 0.7, 0.9)]
    found = gravity(video, pts)
    assert found is not None
    np.testing.assert_allclose(found, [level, level, rolled, rolled], atol=1e-3)
    upside_down = [tree(samples(b"IORI", turned), samples(b"GRAV", [level] * 3))]
    assert gravity(write(tmp_path / "b.mp4", upside_down), pts) is None
    assert gravity(write(tmp_path / "c.mp4", halves, "another track"), pts) is None
    assert gravity(tmp_path / "none.mp4", pts) is None


@pytest.mark.parametrize("cut", [1, 7, 20, 45, 70])
def test_damaged_items_are_no_gravity(tmp_path: Path, cut: int) -> None:
    good = tree(samples(b"GRAV", [[0.0, 1.0, 0.0]] * 3))
    deep = b""
    for _ in range(3000):
        deep = item(b"DEVC", b"\0", 1, min(len(deep), 65535), deep)
    for number, payload in enumerate((good[:cut], good[:12] + b"\xff" * 40 + good[52:], deep)):
        found = gravity(write(tmp_path / f"{cut}-{number}.mp4", [payload]), [0])
        assert found is None or np.isfinite(found).all()
