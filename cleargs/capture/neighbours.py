"""Neighbours of the chosen frames in the video, or among the numbered images, that they were chosen from."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path, PurePosixPath

import cv2
import numpy as np

from cleargs.capture.capture import Capture, SourceFrame
from cleargs.capture.prepare import WorkFrame, read_image
from cleargs.media.video import decode_grey, read_timeline
from cleargs.types import ImageU8

REACH = 2
"""Number of neighbours on each side."""
MAX_GAP_S = 0.1
"""Longest time between neighbours in a video."""
REPEATED = 0.25
"""Largest difference of a repeated frame from the one before, as a share of the median difference of the
consecutive frames around it."""


@dataclass(frozen=True)
class Neighbourhood:
    """A chosen frame of a capture and the frames of the input around it."""

    number: int
    """Number of the chosen frame."""
    times: tuple[float, ...]
    """Times after the chosen frame, s, in ascending order; in frames if the capture has no clock."""
    others: tuple[SourceFrame, ...]


def neighbourhoods(capture: Capture) -> list[Neighbourhood]:
    """Return the frames of ``capture`` that have neighbours, in order."""
    if capture.kind != "video":
        return _in_folder(capture)
    found = []
    for video in dict.fromkeys(frame.path for frame in capture.frames):
        timeline = read_timeline(video)
        places = {pts: place for place, pts in enumerate(timeline.pts)}
        for number, frame in enumerate(capture.frames):
            if frame.path != video or frame.pts is None:
                continue
            middle = places[frame.pts]
            times, others = [], []
            for step in (-1, 1):
                before = middle
                for place in range(middle + step, middle + step * (REACH + 1), step):
                    if not 0 <= place < len(timeline.pts):
                        break
                    if abs(timeline.seconds(place) - timeline.seconds(before)) > MAX_GAP_S:
                        break
                    times.append(timeline.seconds(place) - timeline.seconds(middle))
                    others.append(SourceFrame(frame.name, video, timeline.pts[place]))
                    before = place
            found += _neighbourhood(number, times, others)
    return sorted(found, key=lambda around: around.number)


def _in_folder(capture: Capture) -> list[Neighbourhood]:
    """Return the neighbours by the numbers in the images' names, which must have a common step.

    At least every second image must be left out. The motion between chosen frames, or between photographs,
    says little about that during an exposure.
    """
    if 2 * len(capture.frames) > len(capture.available):
        return []
    numbered: dict[tuple[str, int], SourceFrame] = {}
    for frame in capture.available:
        if (key := _number_of(frame.name)) is not None:
            numbered[key] = frame
    keys = sorted(numbered)
    gaps = Counter(b[1] - a[1] for a, b in pairwise(keys) if a[0] == b[0])
    if not gaps:
        return []
    step = gaps.most_common(1)[0][0]
    found = []
    for number, frame in enumerate(capture.frames):
        if (key := _number_of(frame.name)) is None:
            continue
        times, others = [], []
        for side in (-1, 1):
            for k in range(1, REACH + 1):
                other = numbered.get((key[0], key[1] + side * k * step))
                if other is None:
                    break
                times.append(side * k / (capture.frame_rate or 1.0))
                others.append(other)
        found += _neighbourhood(number, times, others)
    return found


def _number_of(name: str) -> tuple[str, int] | None:
    """Return the name before its last number, and the number."""
    match = re.fullmatch(r"(.*?)(\d+)\D*", PurePosixPath(name).with_suffix("").as_posix())
    return (match[1], int(match[2])) if match else None


def _neighbourhood(number: int, times: list[float], others: list[SourceFrame]) -> list[Neighbourhood]:
    if not times:
        return []
    order = sorted(range(len(times)), key=lambda k: times[k])
    return [Neighbourhood(number, tuple(times[k] for k in order), tuple(others[k] for k in order))]


def pictures(
    around: Sequence[Neighbourhood], frames: Sequence[WorkFrame]
) -> Iterator[tuple[Neighbourhood, list[ImageU8]]]:
    """Yield the grey pictures of each frame and its neighbours in order of time, of the working image's size.

    ``frames`` are all frames of the capture. Each video is decoded once. A neighbourhood with a frame that
    cannot be decoded is left out.
    """
    for video in dict.fromkeys(frames[one.number].source.path for one in around):
        members = [one for one in around if frames[one.number].source.path == video]
        if frames[members[0].number].source.pts is None:
            for one in members:
                sources = _in_order(one, frames[one.number].source)
                yield one, [_resized(_grey(source), frames[one.number]) for source in sources]
        else:
            yield from _of_video(video, members, frames)


def _of_video(
    video: Path, around: Sequence[Neighbourhood], frames: Sequence[WorkFrame]
) -> Iterator[tuple[Neighbourhood, list[ImageU8]]]:
    """Yield the pictures of `pictures` for one video. Pictures that no later frame needs are dropped."""
    wanted = {
        one.number: [source.pts for source in _in_order(one, frames[one.number].source)] for one in around
    }
    waiting = sorted(around, key=lambda one: max(pts or 0 for pts in wanted[one.number]))
    held: dict[int, ImageU8] = {}
    for pts, grey in decode_grey(
        video, {pts for needed in wanted.values() for pts in needed if pts is not None}, upright=True
    ):
        held[pts] = _resized(grey, frames[around[0].number])
        while waiting and max(p or 0 for p in wanted[waiting[0].number]) <= pts:
            one = waiting.pop(0)
            found = [held[p] for p in wanted[one.number] if p is not None and p in held]
            if len(found) == len(one.times) + 1:
                yield one, found
            still_needed = {p for other in waiting for p in wanted[other.number]}
            held = {p: picture for p, picture in held.items() if p in still_needed or p >= pts}


def _in_order(one: Neighbourhood, chosen: SourceFrame) -> list[SourceFrame]:
    before = sum(time < 0.0 for time in one.times)
    return [*one.others[:before], chosen, *one.others[before:]]


def _grey(frame: SourceFrame) -> ImageU8:
    return np.asarray(cv2.cvtColor(read_image(frame), cv2.COLOR_RGB2GRAY), np.uint8)


def _resized(grey: ImageU8, frame: WorkFrame) -> ImageU8:
    return np.asarray(cv2.resize(grey, (frame.width, frame.height), interpolation=cv2.INTER_AREA), np.uint8)


def repeats(shown: Sequence[ImageU8]) -> bool:
    """Return True if one of consecutive pictures repeats the one before, as in a video with a raised rate."""
    pairs = pairwise(shown)
    changes = [float(cv2.norm(a, b, cv2.NORM_L1)) / a.size for a, b in pairs]
    return min(changes) <= REPEATED * float(np.median(changes))
