"""Frames of a video as upright 8-bit sRGB, through PyAV.

Presentation times, rotation, matrix, range and transfer are those of the stream. The defaults are those of
players: limited range, BT.709 from 720 lines on, BT.601 below. Standard dynamic range is treated as sRGB,
because a display shows both alike. HLG and PQ are converted by `cleargs.media.colour.srgb_from_hdr`.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections import Counter
from collections.abc import Collection, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import av
import cv2
import numpy as np
from av.container import InputContainer
from av.filter import Graph
from av.sidedata.sidedata import SideData
from av.stream import Disposition
from av.video.frame import VideoFrame
from av.video.stream import VideoStream

from cleargs.errors import InputError
from cleargs.media import MAX_PIXELS
from cleargs.media.colour import TRANSFERS, rgb_from_yuv, srgb_from_hdr
from cleargs.media.image import reduced_size, to_uint8
from cleargs.safe_io import open_regular
from cleargs.types import ImageF32, ImageU8

_MATRICES = {1: "bt709", 4: "bt601", 5: "bt601", 6: "bt601", 7: "bt709", 9: "bt2020", 10: "bt2020"}
_FULL_RANGE = 2
_PREVIEW = 0.1
_PROGRESSIVE = 1  # AVFieldOrder: 0 is unknown, above 1 are those of two fields
_SLACK_S, _SLACK = 0.5, 0.02
"""Time by which a video may be shorter than stated, s and as a share: frame durations are rounded."""
_LAST_FRAMES = 1.5  # number of mean frame intervals by which the last frame of an MP4 may end too early
_HINT = "copy the file again, or re-encode what is readable: ffmpeg -i IN -c:v libx264 -crf 16 OUT.mp4"


@dataclass(frozen=True)
class Timeline:
    """Presentation times of the frames of a video."""

    pts: tuple[int, ...]
    """Presentation time stamps, ascending."""
    time_base: float
    """Seconds per unit of ``pts``."""
    transfer: str | None
    """``pq`` or ``hlg`` for HDR, else None."""
    interlaced: bool = False
    """True if each frame has two fields. They are deinterlaced when they are decoded."""
    others: int = 0
    """Number of other streams in the file that are videos, not pictures."""
    before: tuple[int, ...] = ()
    """Time stamps of the frames that were cut off at the start."""

    def seconds(self, index: int) -> float:
        """Return the time of a frame after the first frame of the file, s."""
        return (self.pts[index] - (self.before or self.pts)[0]) * self.time_base

    def between(self, start: float | None, end: float | None) -> Timeline:
        """Return the part from ``start`` to ``end``, s, both included. It may have no frame."""
        times = [self.seconds(index) for index in range(len(self.pts))]
        first = 0 if start is None else bisect_left(times, start)
        last = len(times) if end is None else bisect_right(times, end)
        return replace(self, pts=self.pts[first:last], before=self.before + self.pts[:first])


def read_timeline(path: Path) -> Timeline:
    """Read the time stamps of ``path`` without decoding it.

    Raises InputError if it is not a video, is empty, or breaks off.
    """
    with _open(path) as (container, stream):
        pts: list[int] = []
        end = 0
        for packet in container.demux(stream):
            if packet.is_corrupt:
                raise _broken(path, len(pts), stream)
            # Discarded packets (before an edit list's start) are decoded but never shown.
            if packet.pts is not None and packet.size and not packet.is_discard:
                pts.append(packet.pts)
                end = max(end, packet.pts + (packet.duration or 0))
        if not pts:
            raise InputError(f"{path.name} has no frames", hint=_HINT)
        assert stream.time_base is not None
        stated = _stated_seconds(container, stream)
        short = stated - float(end * stream.time_base) > max(_SLACK_S, _SLACK * stated)
        lacks = stream.frames > len(pts) + 1
        if container.format.name.startswith("mov") and stream.duration:
            # The container also counts frames that its edit list hides, as in clips that a phone trimmed or
            # that were cut without encoding. The stated length is that of the shown part.
            left = stream.duration + min(stream.start_time or 0, 0) - end
            lacks &= left * len(pts) > _LAST_FRAMES * (end - min(pts))
        if short or lacks:
            raise _broken(path, len(pts), stream)
        transfer = TRANSFERS.get(int(stream.codec_context.color_trc))
        interlaced = int(stream.codec_context.field_order) > _PROGRESSIVE
        others = len(_by_merit(path)) - 1 if len(container.streams.video) > 1 else 0
        return Timeline(tuple(sorted(set(pts))), float(stream.time_base), transfer, interlaced, others)


def video_size(path: Path) -> tuple[int, int]:
    """Return width and height of the frames by the header of ``path``. Raises InputError."""
    with _open(path) as (_, stream):
        return stream.codec_context.width, stream.codec_context.height


def decode_frames(path: Path, pts: Collection[int]) -> Iterator[tuple[int, ImageU8]]:
    """Decode ``path`` once and yield (pts, RGB [H, W, 3]) of the wanted frames, one in memory at a time.

    Raises InputError if a wanted frame cannot be decoded, or has too many pixels.
    """
    for number, rgb, _ in decode_with_grey(path, pts, ()):
        if rgb is not None:
            yield number, rgb


def decode_with_grey(
    path: Path, pts: Collection[int], grey: Collection[int]
) -> Iterator[tuple[int, ImageU8 | None, ImageU8 | None]]:
    """Decode ``path`` once and yield (pts, RGB [H, W, 3], grey [H, W]) of the frames ``pts`` and ``grey``.

    RGB or grey is None where it is not wanted. Frames ``grey`` that cannot be decoded are left out. Raises
    InputError as `decode_frames` does.
    """
    missing, in_grey = set(pts), set(grey)
    for number, frame, display in _decoded(path, missing | in_grey):
        wide = max(1, round(display.aspect * frame.width))
        rgb = None
        if number in missing:
            missing.discard(number)
            _require_few(f"{path.name}: a frame would have", wide, frame.height, "square pixels")
            rgb = _turned(_rgb(frame), wide, display)
        yield number, rgb, _turned(_grey(frame), wide, display) if number in in_grey else None
    if missing:
        raise InputError(f"{path.name}: {len(missing)} of its frames cannot be decoded", hint=_HINT)


def decode_grey(
    path: Path, pts: Collection[int], long_side: int | None = None
) -> Iterator[tuple[int, ImageU8]]:
    """Yield frames like `decode_frames`, but grey [H, W], and neither turned nor stretched.

    Longer frames are reduced to ``long_side`` px by area averaging. It is several times as fast. Frames that
    cannot be decoded, for example at the start of a clip that was cut out of another, are left out.
    """
    for number, frame, _ in _decoded(path, pts):
        yield number, _grey(frame, long_side)


def _grey(frame: VideoFrame, long_side: int | None = None) -> ImageU8:  # [H, W]
    width, height = reduced_size(frame.width, frame.height, long_side or max(frame.width, frame.height))
    grey = frame.reformat(width=width, height=height, format="gray", interpolation="AREA")
    return np.asarray(grey.to_ndarray(), np.uint8)


class _Display(NamedTuple):
    """Shape of the pixels of a video, and its display matrix."""

    aspect: float
    """Width of a stored pixel over its height."""
    matrix: tuple[int, int, int, int]
    """(a, b, c, d) of the display matrix. It maps a stored pixel (x, y) to (a x + c y, b x + d y)."""


def _decoded(path: Path, pts: Collection[int]) -> Iterator[tuple[int, VideoFrame, _Display]]:
    """Yield the wanted frames that can be decoded; they are all shown as the first of them."""
    wanted, display = set(pts), None
    with _open(path) as (container, stream):
        stream.thread_type = "AUTO"
        for frame in _progressive(container, stream):
            if frame.pts in wanted:
                wanted.discard(frame.pts)
                if display is None:
                    display = _Display(float(stream.sample_aspect_ratio or 1.0), _display_matrix(frame))
                yield frame.pts, frame, display
            if not wanted:
                return


def _display_matrix(frame: VideoFrame) -> tuple[int, int, int, int]:
    """Return the display matrix (`_Display`). `VideoFrame.rotation` has no mirroring.

    A frame whose side data were read stays in memory until Python looks for cycles of references, so only
    one frame of a video is asked.
    """
    matrix = frame.side_data.get("DISPLAYMATRIX")
    if not isinstance(matrix, SideData):
        return 1, 0, 0, 1
    a, b, _, c, d = np.frombuffer(bytes(matrix), np.int32)[:5].tolist()
    return a, b, c, d


def _progressive(container: InputContainer, stream: VideoStream) -> Iterator[VideoFrame]:
    """Decode ``stream``; where its header says that it is interlaced, through FFmpeg's deinterlacer (bwdif).

    Each frame keeps its time and shows the moment of its first field.
    """
    if int(stream.codec_context.field_order) <= _PROGRESSIVE:
        yield from container.decode(stream)
        return
    graph = Graph()
    graph.link_nodes(
        graph.add_buffer(template=stream), graph.add("bwdif", "mode=send_frame"), graph.add("buffersink")
    ).configure()
    for frame in (*container.decode(stream), None):
        graph.vpush(frame)
        with suppress(av.error.BlockingIOError, av.error.EOFError):  # it needs the next frame, or has ended
            while True:
                made = graph.vpull()
                if made.pts is not None and made.time_base and stream.time_base:
                    made.pts = round(made.pts * made.time_base / stream.time_base)
                yield made


def _require_few(subject: str, width: int, height: int, what: str = "pixels") -> None:
    if width * height > MAX_PIXELS:
        raise InputError(f"{subject} {width}x{height} {what}; at most {MAX_PIXELS} are read", hint=_HINT)


def _rgb(frame: VideoFrame) -> ImageU8:  # [H, W, 3]
    """Return the stored picture of a frame as sRGB."""
    rgb = frame.to_ndarray(format="rgb24") if frame.format.is_rgb else to_uint8(_signal(frame))
    return np.asarray(rgb, np.uint8)


def _turned(picture: ImageU8, width: int, display: _Display) -> ImageU8:  # [H, W] or [H, W, 3]
    """Return a stored picture with square pixels, ``width`` of them in a row, turned and mirrored."""
    height = picture.shape[0]
    if width != picture.shape[1]:
        picture = np.asarray(cv2.resize(picture, (width, height), interpolation=cv2.INTER_CUBIC), np.uint8)
    a, b, c, d = display.matrix
    turned, across, down = (picture.swapaxes(0, 1), c, b) if abs(b) > abs(a) else (picture, a, d)
    return np.ascontiguousarray(turned[:: -1 if down < 0 else 1, :: -1 if across < 0 else 1])


def _signal(frame: VideoFrame) -> ImageF32:  # [H, W, 3]
    """Return R'G'B' of a Y'CbCr frame, tone-mapped to sRGB if it is HDR.

    swscale only raises chroma to full resolution, at the stream's depth and range, because its matrix tables
    are up to several levels off.
    """
    bits = max(component.bits for component in frame.format.components)
    full = frame.color_range == _FULL_RANGE or frame.format.name.startswith("yuvj")
    layout = "yuv444p" if bits == 8 else "yuv444p16le"
    side = _FULL_RANGE if full else 1
    planar = frame.reformat(
        format=layout, src_color_range=side, dst_color_range=side, interpolation="BICUBIC"
    )
    yuv = np.moveaxis(planar.to_ndarray(channel_last=True).astype(np.float32), -1, 0)
    matrix = _MATRICES.get(
        int(frame.colorspace), "bt709" if min(frame.width, frame.height) >= 720 else "bt601"
    )
    rgb = rgb_from_yuv(yuv, matrix, 8 if bits == 8 else 16, full_range=full)
    transfer = TRANSFERS.get(int(frame.color_trc))
    return rgb if transfer is None else srgb_from_hdr(np.clip(rgb, 0, 1), transfer)


@contextmanager
def _open(path: Path) -> Iterator[tuple[InputContainer, VideoStream]]:
    """Open the best video stream. Every FFmpeg error inside the block becomes an InputError."""
    try:
        with open_regular(path) as file:
            if not file.read(1):
                raise InputError(f"{path.name} is empty (zero bytes)", hint=_HINT)
        # Titles and comments, which nothing here reads, may be in any encoding.
        with av.open(path, metadata_errors="replace") as container:
            if not container.streams.video:
                raise InputError(f"{path.name} holds no video", hint="give a video, or a folder of images")
            streams = container.streams.video
            stream = streams[_by_merit(path)[0] if len(streams) > 1 else 0]
            if stream.codec_context is None:  # FFmpeg does not know the codec
                raise InputError(f"{path.name} is in a form that cannot be decoded", hint=_HINT)
            if min(stream.width, stream.height) < 1:
                raise InputError(f"{path.name} is damaged: its header gives the picture no size", hint=_HINT)
            _require_few(f"{path.name} has", stream.width, stream.height)
            yield container, stream
    except (av.error.FFmpegError, OSError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise InputError(f"{path.name} cannot be read as a video: {reason}", hint=_HINT) from error


def _by_merit(path: Path) -> list[int]:
    """Return the numbers of the video streams in ``path``, best first, without attached and single pictures.

    The best stream has the most pixels, summed over all its frames. Streams with less than a tenth of its
    pixels are previews and are left out.
    """
    with av.open(path, metadata_errors="replace") as container:
        streams = container.streams.video
        frames = Counter(packet.stream_index for packet in container.demux(streams) if packet.size)
        merit = {
            number: frames[stream.index] * stream.width * stream.height
            for number, stream in enumerate(streams)
            if not stream.disposition & Disposition.attached_pic
        }
    best = max(merit.values(), default=0)
    kept = [number for number in merit if merit[number] >= _PREVIEW * best]
    return sorted(kept, key=lambda number: -merit[number]) or [0]


def _stated_seconds(container: InputContainer, stream: VideoStream) -> float:
    """Return the stated length of a Matroska video, s; 0 if it is unknown, or if the file counts its frames.

    Matroska states only the length of the longest stream, so it is used only if the video is the only one.
    """
    if stream.frames or not container.format.name.startswith("matroska") or len(container.streams) > 1:
        return 0.0
    return float((container.duration or 0) / av.time_base)


def _broken(path: Path, frames: int, stream: VideoStream) -> InputError:
    whole = f" of {stream.frames}" if stream.frames else ""
    return InputError(f"{path.name} is damaged or breaks off after {frames}{whole} frames", hint=_HINT)
