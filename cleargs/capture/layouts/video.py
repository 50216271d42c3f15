"""A video: frames evenly in time."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from cleargs.capture.capture import Capture, External, SourceFrame
from cleargs.capture.config import CaptureConfig

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from cleargs.media.video import Timeline


def detect(source: Path, *, poses: bool) -> bool:
    """See `Layout.detect`: whatever is no folder."""
    return not source.is_dir()


def externals(source: Path, config: CaptureConfig) -> Mapping[str, External]:
    """See `Layout.externals`."""
    return {"capture": source}


def open_capture(source: Path, config: CaptureConfig) -> Capture:
    """See `Layout.open_capture`."""
    from cleargs.media.video import read_timeline

    timeline = read_timeline(source)
    chosen = choose_times(timeline, config.fps, config.max_frames)
    frames = tuple(video_frame(source, timeline, index) for index in chosen)
    return Capture("video", frames, len(timeline.pts), hdr=timeline.transfer)


def video_frame(source: Path, timeline: Timeline, index: int) -> SourceFrame:
    """Frame ``index`` of a video."""
    name = f"{source.stem}_{index:06d}"
    return SourceFrame(name, source, pts=timeline.pts[index], time_s=timeline.seconds(index))


def choose_times(timeline: Timeline, fps: float | None, at_most: int) -> list[int]:
    """Frame numbers evenly in time (not in number: the frame rate may vary): every 1 / fps seconds if given,
    and at most so many from first to last.
    """
    import numpy as np

    times = np.array([timeline.seconds(index) for index in range(len(timeline.pts))])
    span = float(times[-1])
    chosen = (
        list(range(len(times)))
        if fps is None
        else _nearest(times, np.arange(int(span * fps + 1e-6) + 1) / fps)
    )
    return chosen if len(chosen) <= at_most else _nearest(times, np.linspace(0, span, at_most))


def _nearest(times: NDArray[np.float64], wanted: NDArray[np.float64]) -> list[int]:
    """Numbers of the frames nearest to the wanted times, each once; ``times`` start at 0 and ascend."""
    import numpy as np

    after = np.minimum(np.searchsorted(times, wanted), len(times) - 1)
    before = np.maximum(after - 1, 0)
    nearest = np.where(wanted - times[before] <= times[after] - wanted, before, after)
    return sorted({int(index) for index in nearest})
