"""Videos: colours, presentation times, rotation, damage."""

from __future__ import annotations

import gc
import os
import struct
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
from numpy.typing import NDArray

from cleargs.errors import InputError
from cleargs.media import video
from cleargs.media.colour import KNEE, LUMA, linear_from_srgb, srgb_from_hdr, srgb_from_linear, tone_map
from cleargs.media.encode import write_video
from cleargs.media.image import reduced
from cleargs.media.video import decode_frames, decode_grey, read_timeline

# EBU bars at 75 %, with greys and a saturated red, in sRGB code values.
BARS = np.array(
    [
        (191, 191, 191), (191, 191, 0), (0, 191, 191), (0, 191, 0),
        (191, 0, 191), (191, 0, 0), (0, 0, 191), (16, 16, 16), (255, 255, 255), (255, 0, 0),
    ],
    np.float64,
)  # fmt: skip
BAR_WIDTH = 16
MATRIX_CODE = {"bt709": 1, "bt601": 5, "bt2020": 9}


def bar_planes(
    matrix: str, full_range: bool, bits: int = 8, colours: NDArray[np.float64] = BARS
) -> list[NDArray]:
    """4:2:0 planes of vertical bars, by the forward equations of the standard."""
    kr, kb = LUMA[matrix]
    r, g, b = (colours / 255).T
    y = kr * r + (1 - kr - kb) * g + kb * b
    u, v = (b - y) / (2 * (1 - kb)), (r - y) / (2 * (1 - kr))
    step = 2 ** (bits - 8)
    if full_range:
        peak = 2**bits - 1
        codes = [y * peak, u * peak + 128 * step, v * peak + 128 * step]
    else:
        codes = [(16 + 219 * y) * step, (128 + 224 * u) * step, (128 + 224 * v) * step]
    dtype = np.uint8 if bits == 8 else np.uint16
    rounded = [np.clip(np.rint(code), 0, 2**bits - 1).astype(dtype) for code in codes]
    width = (BAR_WIDTH, BAR_WIDTH // 2, BAR_WIDTH // 2)
    return [
        np.tile(np.repeat(code, w), (height, 1))
        for code, w, height in zip(rounded, width, (64, 32, 32), strict=True)
    ]


def encode(
    path: Path,
    planes: list[NDArray],
    *,
    codec: str = "ffv1",
    pixel: str = "yuv420p",
    matrix: int = 1,
    color_range: int = 1,
    transfer: int = 1,
    pts: tuple[int, ...] = (0, 1, 2),
    options: dict[str, str] | None = None,
    aspect: Fraction = Fraction(1),
) -> None:
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=30, options=options or {})
        stream.width, stream.height, stream.pix_fmt = planes[0].shape[1], planes[0].shape[0], pixel
        stream.time_base = stream.codec_context.time_base = Fraction(1, 90)
        context = stream.codec_context
        context.sample_aspect_ratio = aspect
        context.colorspace, context.color_range, context.color_trc = matrix, color_range, transfer
        context.color_primaries = 9 if matrix == 9 else 1
        for index, stamp in enumerate(pts):
            moved = [
                np.roll(plane, index * plane.shape[1] // planes[0].shape[1] * 2, axis=1) for plane in planes
            ]
            frame = av.VideoFrame(planes[0].shape[1], planes[0].shape[0], pixel)
            for plane, values in zip(frame.planes, moved, strict=True):
                row = plane.line_size // values.itemsize
                buffer = np.zeros((values.shape[0], row), values.dtype)
                buffer[:, : values.shape[1]] = values
                plane.update(buffer.tobytes())
            frame.pts, frame.time_base = stamp, Fraction(1, 90)
            frame.colorspace, frame.color_range, frame.color_trc = matrix, color_range, transfer
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))


def bar_centres(rgb: NDArray[np.uint8]) -> NDArray[np.float64]:
    """The colour in the middle of each bar, away from the chroma's transitions."""
    return rgb[32, BAR_WIDTH // 2 :: BAR_WIDTH].astype(np.float64)


@pytest.mark.parametrize("matrix", ["bt709", "bt601", "bt2020"])
@pytest.mark.parametrize("full_range", [False, True])
def test_colour_bars_come_back(tmp_path: Path, matrix: str, full_range: bool) -> None:
    path = tmp_path / "bars.mkv"
    encode(
        path, bar_planes(matrix, full_range), matrix=MATRIX_CODE[matrix], color_range=2 if full_range else 1
    )
    timeline = read_timeline(path)
    _, rgb = next(decode_frames(path, timeline.pts[:1]))
    # Rounding Y'CbCr to 8 bits costs up to 1.5 levels (BT.2020 limited the most).
    assert np.abs(bar_centres(rgb) - BARS).max() <= 2


def test_colour_bars_through_h264(tmp_path: Path) -> None:
    path = tmp_path / "bars.mp4"
    encode(path, bar_planes("bt709", False), codec="libx264", options={"crf": "4", "preset": "ultrafast"})
    _, rgb = next(decode_frames(path, read_timeline(path).pts[:1]))
    # One level more for the codec's own loss.
    assert np.abs(bar_centres(rgb) - BARS).max() <= 3


@pytest.mark.parametrize("colour", [(200, 60, 30), (20, 180, 90), (40, 70, 220), (128, 128, 128)])
def test_a_film_shows_the_colours_that_were_written(tmp_path: Path, colour: tuple[int, int, int]) -> None:
    """By the tags of the file, as players do. PyAV alone converts by another matrix."""
    write_video(tmp_path / "film.mp4", [np.full((64, 96, 3), colour, np.uint8)] * 3, 10.0)
    with av.open(str(tmp_path / "film.mp4")) as container:
        frame = next(container.decode(video=0))
        assert (frame.colorspace, frame.color_range) == (1, 1)  # BT.709, limited
        assert np.abs(frame.to_ndarray(format="rgb24")[32, 48].astype(int) - colour).max() <= 3
    _, rgb = next(decode_frames(tmp_path / "film.mp4", read_timeline(tmp_path / "film.mp4").pts[:1]))
    assert np.abs(rgb[32, 48].astype(int) - colour).max() <= 2


def test_ten_bits_come_back(tmp_path: Path) -> None:
    path = tmp_path / "bars10.mkv"
    encode(path, bar_planes("bt709", False, bits=10), pixel="yuv420p10le")
    _, rgb = next(decode_frames(path, read_timeline(path).pts[:1]))
    assert np.abs(bar_centres(rgb) - BARS).max() <= 1


@pytest.mark.parametrize(("transfer", "code"), [("hlg", 18), ("pq", 16)])
def test_hdr_is_tone_mapped(tmp_path: Path, transfer: str, code: int) -> None:
    path = tmp_path / "hdr.mkv"
    planes = bar_planes("bt2020", False, bits=10)
    encode(path, planes, pixel="yuv420p10le", matrix=9, transfer=code)
    timeline = read_timeline(path)
    assert timeline.transfer == transfer
    _, rgb = next(decode_frames(path, timeline.pts[:1]))
    expected = np.rint(srgb_from_hdr(BARS[None] / 255, transfer)[0] * 255)
    assert np.abs(bar_centres(rgb) - expected).max() <= 2


def test_hdr_reference_white_and_curve() -> None:
    # BT.2408: reference white is 58 % of PQ and 75 % of HLG; the curve maps it to 0.8 linear.
    white = KNEE + (1 - KNEE) / 2
    for transfer, signal in (("pq", 0.5807), ("hlg", 0.75)):
        grey = srgb_from_hdr(np.full((1, 1, 3), signal), transfer)
        assert np.abs(linear_from_srgb(grey) - white).max() < 0.005
    light = np.linspace(0, 50, 2000)[:, None] * np.array([1.0, 0.5, 0.25])
    mapped = tone_map(light)
    assert (np.diff(mapped[:, 0]) > 0).all() and mapped.max() < 1
    assert np.allclose(mapped[light[:, 0] <= KNEE], light[light[:, 0] <= KNEE])


def test_srgb_curve_inverts() -> None:
    values = np.linspace(0, 1, 1001)
    assert np.abs(srgb_from_linear(linear_from_srgb(values)) - values).max() < 1e-7


def test_variable_frame_rate_keeps_its_times(tmp_path: Path) -> None:
    path = tmp_path / "vfr.mkv"
    stamps = (0, 9, 12, 60, 180)
    encode(path, bar_planes("bt709", False), pts=stamps)
    timeline = read_timeline(path)
    times = [timeline.seconds(index) for index in range(len(timeline.pts))]
    # Matroska keeps milliseconds.
    assert np.allclose(times, [stamp / 90 for stamp in stamps], atol=1e-3)


def test_only_wanted_frames_are_yielded(tmp_path: Path) -> None:
    path = tmp_path / "clip.mkv"
    encode(path, bar_planes("bt709", False), pts=tuple(range(0, 30, 3)))
    timeline = read_timeline(path)
    wanted = timeline.pts[2::3]
    frames = dict(decode_frames(path, wanted))
    assert tuple(frames) == wanted
    assert not np.array_equal(frames[wanted[0]], frames[wanted[1]])


def test_pixels_become_square(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """AVCHD and DV have pixels that are wider than high."""
    path = tmp_path / "clip.mp4"
    encode(path, bar_planes("bt709", False), codec="libx264", aspect=Fraction(4, 3))
    (_, wide), *_ = decode_frames(path, read_timeline(path).pts[:1])
    height, width = bar_planes("bt709", False)[0].shape
    assert wide.shape == (height, round(4 * width / 3), 3)
    # A damaged header must not ask for all memory.
    monkeypatch.setattr(video, "MAX_PIXELS", width * height)
    with pytest.raises(InputError, match=r"clip\.mp4: a frame would have .* square pixels"):
        next(decode_frames(path, read_timeline(path).pts[:1]))


def test_a_frame_that_cannot_be_decoded_spoils_no_search(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "clip.mkv"
    encode(path, bar_planes("bt709", False), pts=tuple(range(0, 30, 3)))
    stamps = read_timeline(path).pts
    wanted = [*stamps, stamps[-1] + 5]
    assert [number for number, _ in decode_grey(path, wanted)] == list(stamps)
    with pytest.raises(InputError, match="1 of its frames cannot be decoded"):
        list(decode_frames(path, wanted))


@pytest.mark.parametrize("turn", [0, 90, 180, 270])
def test_rotation_metadata_turns_the_frame(tmp_path: Path, turn: int) -> None:
    path = tmp_path / "turned.mp4"
    encode(path, bar_planes("bt709", False), codec="libx264", options={"crf": "4", "preset": "ultrafast"})
    _, upright = next(decode_frames(path, read_timeline(path).pts[:1]))
    _write_display_matrix(path, turn)
    _, turned = next(decode_frames(path, read_timeline(path).pts[:1]))
    # The matrix says by how much to turn clockwise for display.
    assert np.array_equal(turned, np.rot90(upright, -turn // 90))


def _write_display_matrix(path: Path, clockwise: int) -> None:
    """Put a rotation into the track header, as phones do (16.16 fixed point, the last column 2.30)."""
    a, b = {0: (1, 0), 90: (0, 1), 180: (-1, 0), 270: (0, -1)}[clockwise]
    matrix = [a << 16, b << 16, 0, -b << 16, a << 16, 0, 0, 0, 1 << 30]
    data = bytearray(path.read_bytes())
    start = data.index(b"tkhd") + 4
    assert data[start] == 0  # version 0: the matrix follows 40 bytes of other fields
    struct.pack_into(">9i", data, start + 40, *matrix)
    path.write_bytes(data)


@pytest.mark.parametrize(
    ("matrix", "shown"),
    [
        ((-1, 0, 0, 1), np.s_[:, ::-1]),  # selfies
        ((1, 0, 0, -1), np.s_[::-1]),
        ((0, 1, 1, 0), None),  # mirrored at the diagonal
    ],
)
def test_a_mirrored_video(tmp_path: Path, matrix: tuple[int, ...], shown: Any) -> None:
    path = tmp_path / "mirrored.mp4"
    encode(path, bar_planes("bt709", False), codec="libx264", options={"crf": "4", "preset": "ultrafast"})
    _, stored = next(decode_frames(path, read_timeline(path).pts[:1]))
    data = bytearray(path.read_bytes())
    a, b, c, d = (value << 16 for value in matrix)
    struct.pack_into(">9i", data, data.index(b"tkhd") + 44, a, b, 0, c, d, 0, 0, 0, 1 << 30)
    path.write_bytes(data)
    _, made = next(decode_frames(path, read_timeline(path).pts[:1]))
    assert np.array_equal(made, stored.swapaxes(0, 1) if shown is None else stored[shown])


def test_read_frames_leave_memory_at_once(tmp_path: Path) -> None:
    """60 frames of 1440x1080, not freed before Python looked for cycles, had filled 0.4 GB."""
    path = clip_of_40(tmp_path / "clip.mp4", 0)
    gc.collect()
    gc.disable()
    try:
        assert len(list(decode_frames(path, read_timeline(path).pts))) == 40
        alive = sum(isinstance(thing, av.VideoFrame) for thing in gc.get_objects())
    finally:
        gc.enable()
    assert alive <= 1


def clip_of_40(path: Path, b_frames: int) -> Path:
    """40 frames in 4 s, a key frame in each second."""
    options = {"preset": "ultrafast", "g": "10", "bf": str(b_frames), "sc_threshold": "0"}
    encode(path, bar_planes("bt709", False), codec="libx264", pts=tuple(range(0, 360, 9)), options=options)
    return path


@pytest.mark.parametrize("suffix", [".mp4", ".mov"])
@pytest.mark.parametrize("b_frames", [0, 2])
@pytest.mark.parametrize(("start", "left"), [(1.55, 24), (0.3, 37), (2.0, 20)])
def test_a_clip_that_was_cut_without_encoding(
    tmp_path: Path, suffix: str, b_frames: int, start: float, left: int
) -> None:
    """As ``ffmpeg -ss START -i IN -c copy OUT`` does: from a key frame on, the frames before are hidden."""
    whole, cut = clip_of_40(tmp_path / f"whole{suffix}", b_frames), tmp_path / f"cut{suffix}"
    with av.open(whole) as source, av.open(cut, "w", options={"avoid_negative_ts": "disabled"}) as copy:
        stream = source.streams.video[0]
        assert stream.time_base is not None
        target = copy.add_stream_from_template(stream)
        source.seek(int(start * 1e6))
        for packet in source.demux(stream):
            if packet.dts is not None and packet.pts is not None:
                packet.pts -= int(start / stream.time_base)
                packet.dts -= int(start / stream.time_base)
                packet.stream = target
                copy.mux(packet)
    timeline = read_timeline(cut)
    assert abs(len(timeline.pts) - left) <= 1 and len(list(decode_frames(cut, timeline.pts))) >= left - 1


@pytest.mark.parametrize(
    ("edits", "left"),
    [
        ([(2.0, 0.0)], 20),  # the end was trimmed by a phone
        ([(1.5, 1.2)], 15),
        ([(1.0, 0.0), (1.0, 2.0)], 20),  # the middle was cut out
        ([(0.5, -1.0), (1.0, 1.0)], 10),  # it begins late
    ],
)
def test_a_clip_that_a_phone_trimmed(tmp_path: Path, edits: list[tuple[float, float]], left: int) -> None:
    path = clip_of_40(tmp_path / "a.mp4", 0)
    with av.open(path) as opened:
        scale = 1 / opened.streams.video[0].time_base
    write_edits(path, [(round(1000 * s), -1 if at < 0 else round(at * scale)) for s, at in edits])
    assert len(read_timeline(path).pts) == left


def write_edits(path: Path, edits: list[tuple[int, int]]) -> None:
    """Put an edit list of (length, start in the media) into the only track of an MP4 file."""
    data = bytearray(path.read_bytes())

    def size(at: int) -> int:
        return int(struct.unpack_from(">I", data, at)[0])

    if (old := data.find(b"edts") - 4) >= 0:
        change = -size(old)
        del data[old : old - change]
    else:
        change = 0
    entries = b"".join(struct.pack(">Iii", length, at, 1 << 16) for length, at in edits)
    box = struct.pack(">I4sII", 16 + len(entries), b"elst", 0, len(edits)) + entries
    box = struct.pack(">I4s", 8 + len(box), b"edts") + box
    header = data.index(b"tkhd") - 4
    data[header + size(header) : header + size(header)] = box
    for name in (b"moov", b"trak"):
        at = data.index(name) - 4
        struct.pack_into(">I", data, at, size(at) + change + len(box))
    path.write_bytes(data)


def test_empty_video(tmp_path: Path) -> None:
    path = tmp_path / "empty.mp4"
    path.touch()
    with pytest.raises(InputError, match="empty"):
        read_timeline(path)


@pytest.mark.parametrize("faststart", [True, False])
def test_truncated_video(tmp_path: Path, faststart: bool) -> None:
    whole, cut = tmp_path / "whole.mp4", tmp_path / "cut.mp4"
    noise = [
        np.random.default_rng(0).integers(16, 235, plane.shape, np.uint8)
        for plane in bar_planes("bt709", False)
    ]
    encode(whole, noise, codec="libx264", pts=tuple(range(0, 60, 3)), options={"preset": "ultrafast"})
    if faststart:
        with (
            av.open(str(whole)) as source,
            av.open(str(cut), "w", container_options={"movflags": "faststart"}) as copy,
        ):
            stream = copy.add_stream_from_template(source.streams.video[0])
            for packet in source.demux(video=0):
                if packet.dts is not None:
                    packet.stream = stream
                    copy.mux(packet)
        data = cut.read_bytes()
    else:
        data = whole.read_bytes()
    cut.write_bytes(data[: len(data) * 2 // 3])
    with pytest.raises(InputError, match=r"breaks off|cannot be read|damaged"):
        read_timeline(cut)


def test_truncated_matroska(tmp_path: Path) -> None:
    """The demuxer ends without an error where the file ends; only the stated length shows the damage."""
    whole, cut = tmp_path / "whole.mkv", tmp_path / "cut.mkv"
    encode(whole, bar_planes("bt709", False), pts=tuple(range(0, 360, 3)))
    assert len(read_timeline(whole).pts) == 120
    data = whole.read_bytes()
    cut.write_bytes(data[: len(data) // 2])
    with pytest.raises(InputError, match="breaks off after"):
        read_timeline(cut)


def test_not_a_video(tmp_path: Path) -> None:
    path = tmp_path / "notes.mp4"
    path.write_text("these are notes")
    with pytest.raises(InputError, match="cannot be read as a video"):
        read_timeline(path)


def test_a_codec_that_nobody_knows(tmp_path: Path) -> None:
    path = tmp_path / "v.mp4"
    write_video(path, [np.zeros((32, 32, 3), np.uint8)] * 3, 10.0)
    path.write_bytes(path.read_bytes().replace(b"avc1", b"zzzz"))
    with pytest.raises(InputError, match="in a form that cannot be decoded"):
        read_timeline(path)


@pytest.mark.parametrize("suffix", [".avi", ".mkv", ".mp4"])
def test_a_title_in_another_encoding(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"v{suffix}"
    title = b"Caf\xe9 in Latin-1"
    with av.open(path, "w") as container:
        container.metadata["title"] = "Cafe in Latin-1"
        stream = container.add_stream("mpeg4", rate=10)
        stream.width, stream.height, stream.pix_fmt = 32, 32, "yuv420p"
        for _ in range(4):
            container.mux(stream.encode(av.VideoFrame(32, 32, "yuv420p")))
        container.mux(stream.encode())
    data = path.read_bytes()
    assert data.count(b"Cafe in Latin-1") == 1
    path.write_bytes(data.replace(b"Cafe in Latin-1", title))
    assert len(read_timeline(path).pts) == 4


def test_a_fifo_is_no_video(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "v.mp4")
    with pytest.raises(InputError, match="not a regular file"):
        read_timeline(tmp_path / "v.mp4")


def test_a_grey_frame_is_reduced_like_a_picture(tmp_path: Path) -> None:
    path = tmp_path / "clip.mkv"
    encode(path, bar_planes("bt709", False))
    stamps = read_timeline(path).pts[:1]
    (_, whole), (_, small) = next(decode_grey(path, stamps)), next(decode_grey(path, stamps, 16))
    expected = reduced(whole, 16)
    assert small.shape == expected.shape and max(small.shape) == 16
    assert np.corrcoef(small.ravel(), expected.ravel())[0, 1] > 0.99  # FFmpeg's weights differ at edges
    assert np.array_equal(next(decode_grey(path, stamps, 4 * max(whole.shape)))[1], whole)
