"""Frames to an H.264 video, through PyAV."""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
from av.video.frame import VideoFrame
from numpy.typing import NDArray

from cleargs.errors import InputError
from cleargs.files import atomic_path
from cleargs.media.colour import LUMA

_BT709, _LIMITED = 1, 1
_CRF = "12"
"""x264's constant rate factor: no visible loss."""
_AS_IT_COMES = "threads=1:mbtree=0:rc-lookahead=0:bframes=0"
"""Each frame is coded as it comes, as a phone does. With look-ahead at a held rate x264 gave other bytes from
call to call, one thread or not."""


def require_even(width: int, height: int) -> None:
    """Raise InputError for a size that no 4:2:0 video can have (it has half as many chroma samples)."""
    if width % 2 or height % 2:
        raise InputError(
            f"a video cannot have {width}x{height} pixels", hint="choose an even width and an even height"
        )


def write_video(
    path: Path,
    frames: Sequence[NDArray[np.uint8]],  # [H, W, 3] sRGB each
    fps: float,
    bits_per_pixel: float | None = None,
) -> None:
    """Write ``frames`` as an MP4: H.264, 4:2:0, BT.709, limited range, ``fps`` frames a second.

    Without visible loss, or at ``bits_per_pixel`` bits a pixel of each frame, held over a second, by one
    thread, so that equal frames give equal bytes.

    Raises InputError like `require_even`, StoreError when the disk is full or not writable.
    """
    height, width = frames[0].shape[:2]
    require_even(width, height)
    rate = Fraction(fps).limit_denominator(1001)
    with atomic_path(path) as temporary, av.open(temporary, "w") as container:
        options = {"preset": "medium"}
        if bits_per_pixel is None:
            options["crf"] = _CRF
        else:
            bits = str(round(bits_per_pixel * width * height * fps))
            options |= {"b": bits, "maxrate": bits, "bufsize": bits, "x264-params": _AS_IT_COMES}
        stream = container.add_stream("libx264", rate=rate, options=options)
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
        context = stream.codec_context
        context.colorspace = context.color_primaries = context.color_trc = _BT709
        context.color_range = _LIMITED
        for number, rgb in enumerate(frames):
            frame = _planar(rgb).reformat(
                format="yuv420p", src_color_range=_LIMITED, dst_color_range=_LIMITED, interpolation="BICUBIC"
            )
            frame.pts, frame.time_base = number, 1 / rate
            container.mux(stream.encode(frame))
        container.mux(stream.encode())


def _planar(rgb: NDArray[np.uint8]) -> VideoFrame:
    """RGB as 4:4:4 Y'CbCr; swscale only thins out the chroma, since its matrix is several levels off."""
    kr, kb = LUMA["bt709"]
    red, green, blue = np.moveaxis(rgb / 255, -1, 0)
    luma = kr * red + (1 - kr - kb) * green + kb * blue
    planes = [
        16 + 219 * luma,
        128 + 112 * (blue - luma) / (1 - kb),
        128 + 112 * (red - luma) / (1 - kr),
    ]
    return VideoFrame.from_ndarray(np.rint(np.stack(planes)).astype(np.uint8), format="yuv444p")
