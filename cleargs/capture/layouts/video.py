"""Videos: frames evenly spaced in time, of one video or of all videos in a folder."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from cleargs.capture.capture import Capture, External, SourceFrame
from cleargs.capture.config import CaptureConfig
from cleargs.capture.contents import contents_of, media_files
from cleargs.errors import InputError
from cleargs.media import VIDEO_SUFFIXES

if TYPE_CHECKING:
    from cleargs.media.video import Timeline
    from cleargs.types import ArrayF64


def detect(source: Path, config: CaptureConfig) -> bool:
    """See `Layout.detect`: a file, or a folder in which videos are the capture."""
    if not source.is_dir():
        return True
    suffixes = {path.suffix.lower() for path in media_files(source)}
    return bool(suffixes & VIDEO_SUFFIXES) and contents_of(source, config).is_video


def externals(source: Path, config: CaptureConfig) -> Mapping[str, External]:
    videos = contents_of(source, config).videos if source.is_dir() else [source]
    if len(videos) == 1:
        return {"capture": videos[0]}
    return {"videos": {name: video for video, name in _names(videos, source).items()}}


def open_capture(source: Path, config: CaptureConfig) -> Capture:
    """See `Layout.open_capture`. Each video gets frames in proportion to its length."""
    from cleargs.media.video import read_timeline

    contents = contents_of(source, config) if source.is_dir() else None
    videos = list(contents.videos) if contents is not None else [source]
    whole = [read_timeline(video) for video in videos]
    timelines = [timeline.between(config.start, config.end) for timeline in whole]
    if not any(timeline.pts for timeline in timelines):
        longest = max(timeline.seconds(-1) for timeline in whole)
        raise InputError(
            f"no frame of {source.name} is between ingest.start and ingest.end: it lasts {longest:.1f} s",
            hint="give times in seconds from the first frame on, the start before the end",
        )
    frames: list[SourceFrame] = []
    shares = _shares(timelines, config.max_frames)
    stems, names = Counter(video.stem for video in videos), _names(videos, source)
    for video, timeline, at_most in zip(videos, timelines, shares, strict=True):
        if timeline.pts and at_most:
            name = video.stem if stems[video.stem] == 1 else names[video]
            chosen = choose_times(timeline, config.fps, at_most)
            frames += [video_frame(video, timeline, index, name) for index in chosen]
    return Capture(
        "video",
        tuple(frames),
        sum(len(timeline.pts) for timeline in timelines),
        hdr=next((timeline.transfer for timeline in whole if timeline.transfer), None),
        stretch=(config.start, config.end),
        told="" if contents is None else contents.told(),
        notes=(*_notes(videos, whole), *(contents.warnings() if contents is not None else ())),
    )


def video_frame(source: Path, timeline: Timeline, index: int, prefix: str) -> SourceFrame:
    """Return frame ``index`` of ``timeline``. Its number in its name counts from the start of the file."""
    name = f"{prefix}_{len(timeline.before) + index:06d}"
    return SourceFrame(name, source, pts=timeline.pts[index], time_s=timeline.seconds(index))


def choose_times(timeline: Timeline, fps: float | None, at_most: int) -> list[int]:
    """Return frame numbers evenly in time (not in number: the frame rate may vary).

    They are 1 / ``fps`` seconds apart if that is given. At most ``at_most`` are chosen, from first to last.
    """
    import numpy as np

    times = np.array([timeline.seconds(index) for index in range(len(timeline.pts))])
    times -= times[0]
    span = float(times[-1])
    wanted = times if fps is None else np.arange(int(span * fps + 1e-6) + 1) / fps
    chosen = _nearest(times, wanted)
    return chosen if len(chosen) <= at_most else _nearest(times, np.linspace(0, span, at_most))


def _names(videos: Sequence[Path], source: Path) -> dict[Path, str]:
    """Return video -> its path below the folder ``source``, or its name if it is the input itself."""
    return {
        video: video.relative_to(source).as_posix() if video != source else video.name for video in videos
    }


def _shares(timelines: Sequence[Timeline], at_most: int) -> list[int]:
    """Divide ``at_most`` frames among the videos in proportion to their lengths, by largest remainders."""
    spans = [timeline.seconds(-1) - timeline.seconds(0) if timeline.pts else 0.0 for timeline in timelines]
    if not any(spans):  # each has a single frame
        spans = [float(bool(timeline.pts)) for timeline in timelines]
    wanted = [at_most * span / sum(spans) for span in spans]
    shares = [int(share) for share in wanted]
    order = sorted(range(len(wanted)), key=lambda number: shares[number] - wanted[number])
    for number in order[: at_most - sum(shares)]:
        shares[number] += 1
    return shares


def _notes(videos: Sequence[Path], timelines: Sequence[Timeline]) -> list[str]:
    notes = []
    for video, timeline in zip(videos, timelines, strict=True):
        if timeline.others:
            notes.append(
                f"{video.name} holds {timeline.others + 1} videos: the one with the most pixels is read; "
                "to read another, copy it into a file without the others (ffmpeg -map)"
            )
        if timeline.interlaced:
            notes.append(f"{video.name} is interlaced: each frame is made from its first field (bwdif)")
    return notes


def _nearest(times: ArrayF64, wanted: ArrayF64) -> list[int]:
    """Return the numbers of the frames nearest to ``wanted``, each once. ``times`` ascend from 0."""
    import numpy as np

    after = np.minimum(np.searchsorted(times, wanted), len(times) - 1)
    before = np.maximum(after - 1, 0)
    nearest = np.where(wanted - times[before] <= times[after] - wanted, before, after)
    return sorted({int(index) for index in nearest})
