"""Choice of frames: the sharpest frame of a video near each chosen time, and the held-out test frames."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from fnmatch import fnmatchcase
from pathlib import Path

import cv2
import numpy as np

from cleargs.capture.capture import Capture, SourceFrame
from cleargs.capture.layouts.video import video_frame
from cleargs.capture.pace import Pace, even_places
from cleargs.errors import InputError
from cleargs.media.video import decode_grey, read_timeline
from cleargs.progress import Reporter
from cleargs.types import ImageU8

_BINOMIAL = np.array([1, 4, 6, 4, 1], np.float32)
_REACH, _BAND = 3, 64
"""Reach of both filters of `sharpness`, and the number of rows that are filtered at once. Such bands stay in
the cache of a core: they take a fifth of the time of a whole picture of 960x720."""
_FOLLOWED_S = 0.1
"""Time between the frames of a video in which the motion of the picture is followed."""


def select_sharp_frames(
    capture: Capture, long_side: int, reporter: Reporter, *, by_motion: bool = True
) -> Capture:
    """Return ``capture`` with each frame of a video replaced by the sharpest of its stretch of time.

    A frame's stretch is the frames of the video that are closest in time to it. Ties go to the earlier frame.
    Each video is decoded once. With ``by_motion``, the stretches of a video whose pace is uneven have the
    same motion, not the same duration.
    """
    if capture.kind != "video":
        return capture
    videos = dict.fromkeys(frame.path for frame in capture.frames)
    chosen = (
        frame for video in videos for frame in _sharpest_of(video, capture, long_side, reporter, by_motion)
    )
    return replace(capture, frames=tuple(chosen))


def _sharpest_of(
    video: Path, capture: Capture, long_side: int, reporter: Reporter, by_motion: bool
) -> list[SourceFrame]:
    """Return the sharpest frame of each stretch of ``video``."""
    frames = [frame for frame in capture.frames if frame.path == video]
    timeline = read_timeline(video).between(*capture.stretch)
    times = np.array([frame.pts for frame in frames], np.float64)
    nearest = np.searchsorted((times[1:] + times[:-1]) / 2, timeline.pts)
    if len(nearest) == len(times):
        return frames
    values, pace, followed = np.full(len(nearest), -1.0), Pace(), list[int]()
    between = (timeline.seconds(len(nearest) - 1) - timeline.seconds(0)) / (len(nearest) - 1)
    every = max(1, round(_FOLLOWED_S / max(between, 1e-6)))
    numbers = {pts: number for number, pts in enumerate(timeline.pts)}
    with reporter.task("looking for sharp frames", len(numbers)) as task:
        for pts, picture in decode_grey(video, numbers, long_side):
            values[numbers[pts]] = sharpness(picture)
            if by_motion and (not followed or numbers[pts] >= followed[-1] + every):
                followed.append(numbers[pts])
                pace.add(picture)
            task.advance()
    stretches = [np.flatnonzero(nearest == place) for place in range(len(times))]
    if any((values[stretch] < 0.0).all() for stretch in stretches):
        raise InputError(
            f"{video.name}: of a stretch of it no frame can be decoded",
            hint="convert the video with ffmpeg, or cut the damaged part off",
        )
    if by_motion:
        distances = np.interp(np.arange(len(nearest)), followed, pace.distances())
        places = even_places(
            distances, np.array([numbers[frame.pts] for frame in frames if frame.pts is not None])
        )
        if places is not None:
            reporter.info(f"{video.name}: the pace is uneven; frames are taken by the motion of the picture")
            stretches = [np.flatnonzero(places == place) for place in np.unique(places)]
    chosen = [int(stretch[values[stretch].argmax()]) for stretch in stretches]
    prefix = frames[0].name.rpartition("_")[0]
    return [video_frame(video, timeline, number, prefix) for number in chosen]


def sharpness(image: ImageU8) -> float:  # [H, W, 3] RGB, or [H, W] grey
    """Return the variance (>= 0) of the Laplacian of the grey image after a 5x5 binomial filter, sigma 1 px.

    It grows with the texture in view too, so it ranks neighbours, not a whole capture. Without the filter,
    noise would rank first. All values are whole numbers below 2^24, so the sums are exact.
    """
    grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    total = squares = 0
    for top in range(0, len(grey), _BAND):
        before = min(top, _REACH)
        band = grey[top - before : top + _BAND + _REACH]
        smooth = cv2.sepFilter2D(band, cv2.CV_32F, _BINOMIAL, _BINOMIAL)
        laplacian = np.asarray(cv2.Laplacian(smooth, cv2.CV_32F))[before : before + _BAND].astype(np.int64)
        total += int(laplacian.sum())
        squares += int((laplacian**2).sum())
    count = grey.size
    # The filter's weights sum to 256.
    return float(count * squares - total**2) / count**2 / 256**2


def held_out(
    rule: str, names: Sequence[str], read: Callable[[int], ImageU8], registered: Sequence[bool]
) -> set[int]:
    """Return the numbers of the test frames by the ``rule`` in ``ingest.holdout``.

    every:N holds out frames 0, N, 2N, ..., as Mip-NeRF 360 and 3DGS do with N = 8. sharpest:N holds out the
    sharpest of every N ``registered`` frames in a row, also of the last, shorter group, as 3dgs-deblur's
    ``train_eval_split_by_blur_score.py`` does. ``read`` returns an image. Ties go to the earlier frame.
    Raises InputError for unknown names, or if no registered frame is left for training.
    """
    kind, _, number = rule.partition(":")
    chosen: set[int] = set()
    if kind == "every":
        chosen = set(range(0, len(names), int(number)))
    elif kind == "sharpest":
        period = int(number)
        candidates = [index for index in range(len(names)) if registered[index]]
        stretches = [candidates[start : start + period] for start in range(0, len(candidates), period)]
        chosen = {max(stretch, key=lambda index: sharpness(read(index))) for stretch in stretches}
    elif rule != "none":
        items = filter(None, map(str.strip, rule.split(",")))
        chosen = {index for item in items for index in _matching(item, names)}
    if not any(flag and index not in chosen for index, flag in enumerate(registered)):
        raise InputError(f"ingest.holdout={rule} leaves no frame to train on", hint="hold out fewer frames")
    return chosen


def holdout_hash(rule: str, names: Iterable[str]) -> str:
    """Return the SHA-256 of the rule and the sorted names of the test frames, which identifies the split."""
    return hashlib.sha256(json.dumps([rule, sorted(names)]).encode()).hexdigest()


def _matching(item: str, names: Sequence[str]) -> list[int]:
    """Return numbers of frames whose path, name or stem is or matches ``item`` (``*``, ``?``, ``[]``)."""
    found = []
    for index, name in enumerate(names):
        spellings = (name, Path(name).name, Path(name).stem)
        if item in spellings or any(fnmatchcase(spelling, item) for spelling in spellings):
            found.append(index)
    if not found:
        raise InputError(
            f"ingest.holdout names the frame {item}, which is not among the chosen frames",
            hint="use names or stems of frames of the capture (cleargs show RUN ingest lists them)",
        )
    return found
