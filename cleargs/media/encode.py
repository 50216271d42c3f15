"""Frames to an MP4 video (H.264 or AV1), through PyAV."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from fractions import Fraction
from itertools import chain
from pathlib import Path
from typing import Literal

import av
import numpy as np
from av.video.frame import VideoFrame
from av.video.stream import VideoStream

from cleargs.errors import InputError
from cleargs.files import atomic_path
from cleargs.media.colour import LUMA
from cleargs.types import ImageU8

Codec = Literal["h264", "av1"]

_BT709, _LIMITED = 1, 1
_ENCODERS: Mapping[Codec, tuple[str, Mapping[str, str]]] = {
    "h264": ("libx264", {"preset": "medium", "crf": "12"}),
    "av1": ("libsvtav1", {"preset": "8", "crf": "20"}),
}
"""Encoder and its settings: constant quality, no visible loss."""
_AS_IT_COMES = "threads=1:mbtree=0:rc-lookahead=0:bframes=0"
"""Each frame is coded without look-ahead, as a phone does. With look-ahead x264 gave different bytes from
call to call, even with one thread: at a fixed rate, and at constant quality with B-frames."""


def require_even(width: int, height: int) -> None:
    """Raise InputError for an odd size, which no 4:2:0 video can have: it halves the chroma."""
    if width % 2 or height % 2:
        raise InputError(
            f"a video cannot have {width}x{height} pixels", hint="choose an even width and an even height"
        )


def write_video(
    path: Path,
    frames: Iterable[ImageU8],  # [H, W, 3] sRGB each
    fps: float,
    bits_per_pixel: float | None = None,
    *,
    codec: Codec = "h264",
    repeatable: bool = False,
) -> None:
    """Write ``frames`` (at least one, read one by one) as an MP4: 4:2:0, BT.709, limited range.

    ``bits_per_pixel`` is the rate over each second. None: constant quality, no visible loss. With a rate, or
    with H.264 if ``repeatable``, one thread encodes, so that equal frames give equal bytes. Raises InputError
    for an odd size or if this PyAV has no such encoder, and StoreError if the disk is full or not writable.
    """
    encoder, options = _ENCODERS[codec][0], dict(_ENCODERS[codec][1])
    os.environ.setdefault("SVT_LOG", "1")  # errors only: SVT-AV1 prints all its settings on stderr
    try:
        av.codec.Codec(encoder, "w")
    except av.codec.codec.UnknownCodecError:
        raise InputError(
            f"this PyAV is built without {encoder}",
            hint="choose another --codec, or install the wheel of PyAV (pip install --force-reinstall av)",
        ) from None
    frames = iter(frames)
    first = next(frames)
    height, width = first.shape[:2]
    require_even(width, height)
    rate = Fraction(fps).limit_denominator(1001)
    with atomic_path(path) as temporary, av.open(temporary, "w") as container:
        if repeatable or bits_per_pixel is not None:
            options["x264-params"] = _AS_IT_COMES
        if bits_per_pixel is not None:
            del options["crf"]
            bits = str(round(bits_per_pixel * width * height * fps))
            options |= {"b": bits, "maxrate": bits, "bufsize": bits}
        stream = container.add_stream(encoder, rate=rate, options=options)
        assert isinstance(stream, VideoStream)
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
        context = stream.codec_context
        context.colorspace = context.color_primaries = context.color_trc = _BT709
        context.color_range = _LIMITED
        for number, rgb in enumerate(chain([first], frames)):
            frame = _planar(rgb).reformat(
                format="yuv420p", src_color_range=_LIMITED, dst_color_range=_LIMITED, interpolation="BICUBIC"
            )
            frame.pts, frame.time_base = number, 1 / rate
            container.mux(stream.encode(frame))
        container.mux(stream.encode())


def _planar(rgb: ImageU8) -> VideoFrame:
    """Return RGB as 4:4:4 Y'CbCr.

    swscale is used only to reduce the chroma: its colour matrix is off by several levels.
    """
    kr, kb = LUMA["bt709"]
    red, green, blue = np.moveaxis(rgb / 255, -1, 0)
    luma = kr * red + (1 - kr - kb) * green + kb * blue
    planes = [16 + 219 * luma, 128 + 112 * (blue - luma) / (1 - kb), 128 + 112 * (red - luma) / (1 - kr)]
    return VideoFrame.from_ndarray(np.rint(np.stack(planes)).astype(np.uint8), format="yuv444p")
