"""Videos in containers that hold more than one stream, and interlaced ones."""

from __future__ import annotations

import struct
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from cleargs.errors import InputError
from cleargs.media.video import decode_frames, decode_grey, read_timeline, video_size

STEP = 16
"""Pixels that the picture moves per frame; half of them per field."""


def pan() -> NDArray[np.uint8]:
    """A soft texture, [64, 800], of which each frame shows 96 columns."""
    noise = cv2.GaussianBlur(np.random.default_rng(0).random((64, 800)).astype(np.float32), (0, 0), 3)
    return np.asarray(cv2.normalize(noise, None, 0, 255, cv2.NORM_MINMAX), np.uint8)


def add_frames(stream: av.VideoStream, container: av.container.OutputContainer, grey: list[NDArray]) -> None:
    for picture in grey:
        container.mux(
            stream.encode(av.VideoFrame.from_ndarray(picture, format="gray").reformat(format=stream.pix_fmt))
        )
    container.mux(stream.encode(None))


def with_thumbnail(path: Path, frames: int = 12) -> Path:
    """First a stream of one small JPEG, then the video."""
    with av.open(str(path), "w") as container:
        thumbnail = container.add_stream("mjpeg", rate=1)
        thumbnail.width, thumbnail.height, thumbnail.pix_fmt = 48, 32, "yuvj420p"
        video = container.add_stream("libx264", rate=25)
        video.width, video.height, video.pix_fmt = 96, 64, "yuv420p"
        add_frames(thumbnail, container, [pan()[:32, :48]])
        add_frames(video, container, [pan()[:, i : i + 96] for i in range(frames)])
    return path


@pytest.mark.parametrize("suffix", ["mp4", "mkv"])
def test_a_thumbnail_is_not_the_video(tmp_path: Path, suffix: str) -> None:
    path = with_thumbnail(tmp_path / f"a.{suffix}")
    timeline = read_timeline(path)
    assert len(timeline.pts) == 12 and timeline.others == 0
    assert video_size(path) == (96, 64)
    assert [rgb.shape for _, rgb in decode_frames(path, timeline.pts[:2])] == [(64, 96, 3)] * 2


def test_of_several_long_streams_the_largest_is_taken(tmp_path: Path) -> None:
    with av.open(str(tmp_path / "a.mkv"), "w") as container:
        streams = []
        for width in (48, 96):
            stream = container.add_stream("libx264", rate=25)
            stream.width, stream.height, stream.pix_fmt = width, 64, "yuv420p"
            streams.append((stream, width))
        for stream, width in streams:
            add_frames(stream, container, [pan()[:, i : i + width] for i in range(12)])
    timeline = read_timeline(tmp_path / "a.mkv")
    assert video_size(tmp_path / "a.mkv") == (96, 64) and timeline.others == 1


def interlaced(path: Path, frames: int = 8) -> Path:
    """The odd rows of each frame were taken half a frame later."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=25)
        stream.width, stream.height, stream.pix_fmt = 96, 64, "yuv420p"
        stream.options = {"flags": "+ildct+ilme", "x264-params": "tff=1", "crf": "4"}
        pictures = []
        for index in range(frames):
            at = STEP * index
            picture = pan()[:, at : at + 96].copy()
            picture[1::2] = pan()[1::2, at + STEP // 2 : at + STEP // 2 + 96]
            pictures.append(picture)
        add_frames(stream, container, pictures)
    return path


@pytest.mark.parametrize("suffix", ["mp4", "mkv"])
def test_interlaced_frames_show_one_moment(tmp_path: Path, suffix: str) -> None:
    path = interlaced(tmp_path / f"a.{suffix}")
    timeline = read_timeline(path)
    assert timeline.interlaced and len(timeline.pts) == 8
    wanted = timeline.pts[2:6]
    found = {pts: rgb[..., 0].astype(float) for pts, rgb in decode_frames(path, wanted)}
    assert sorted(found) == list(wanted)
    for index, pts in enumerate(wanted, 2):
        moments = [pan()[:, STEP * index + off : STEP * index + off + 96] for off in (0, STEP // 2)]
        nearest = min(np.abs(found[pts] - moment)[4:-4, 8:-8].mean() for moment in moments)
        assert nearest < 5  # combed, it is 15 from both
    combs = [np.abs(np.diff(grey.astype(float), axis=0)).mean() for _, grey in decode_grey(path, wanted)]
    assert len(combs) == 4 and max(combs) < 2 * np.abs(np.diff(pan().astype(float), axis=0)).mean()


def test_a_progressive_video_is_not_filtered(tmp_path: Path) -> None:
    assert not read_timeline(with_thumbnail(tmp_path / "a.mp4")).interlaced


def test_a_header_without_a_size_is_named(tmp_path: Path) -> None:
    path = tmp_path / "a.mov"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("qtrle", rate=25)
        stream.width, stream.height, stream.pix_fmt = 96, 64, "rgb24"
        add_frames(stream, container, [pan()[:, :96]] * 3)
    path.write_bytes(path.read_bytes().replace(struct.pack(">HH", 96, 64), bytes(4)))
    with pytest.raises(InputError, match=r"a\.mov is damaged: its header gives the picture no size"):
        video_size(path)
