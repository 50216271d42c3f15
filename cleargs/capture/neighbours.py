"""Neighbours of the chosen frames in the video, or among the numbered images, that they were chosen from."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path, PurePosixPath

import cv2
import numpy as np

from cleargs.capture.capture import Capture, SourceFrame
from cleargs.files import atomic_path
from cleargs.media.video import read_timeline
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


class Gatherer:
    """Gathers the pictures of the neighbourhoods of one video. `add` receives its frames in order of time."""

    def __init__(self, around: Mapping[Path, tuple[Neighbourhood, SourceFrame]]) -> None:
        """Take file -> neighbourhood and its chosen frame. `read_pictures` reads the file."""
        self._stamps = {
            file: [source.pts for source in in_order(one, chosen) if source.pts is not None]
            for file, (one, chosen) in around.items()
        }
        self._waiting = sorted(self._stamps, key=lambda file: max(self._stamps[file]))
        self._held: dict[int, ImageU8] = {}

    @property
    def stamps(self) -> set[int]:
        """Time stamps of the frames that are needed."""
        return {pts for stamps in self._stamps.values() for pts in stamps}

    def add(self, pts: int, grey: ImageU8) -> None:  # [H, W]
        """Write the pictures of the neighbourhoods that end with the frame ``pts``.

        A neighbourhood with a frame that cannot be decoded gets no file.
        """
        self._held[pts] = grey
        while self._waiting and max(self._stamps[self._waiting[0]]) <= pts:
            file = self._waiting.pop(0)
            shown = [self._held[stamp] for stamp in self._stamps[file] if stamp in self._held]
            if len(shown) == len(self._stamps[file]):
                with atomic_path(file) as temporary:
                    np.save(temporary, np.stack(shown), allow_pickle=False)
            needed = {stamp for other in self._waiting for stamp in self._stamps[other]}
            self._held = {stamp: picture for stamp, picture in self._held.items() if stamp in needed}


def read_pictures(file: Path) -> list[ImageU8] | None:
    """Return the grey pictures of a neighbourhood in order of time; None if it has no file."""
    return list(np.load(file, allow_pickle=False)) if file.is_file() else None


def in_order(one: Neighbourhood, chosen: SourceFrame) -> list[SourceFrame]:
    """Return the frames of a neighbourhood, with its ``chosen`` one, in order of time."""
    before = sum(time < 0.0 for time in one.times)
    return [*one.others[:before], chosen, *one.others[before:]]


def repeats(shown: Sequence[ImageU8]) -> bool:
    """Return True if one of consecutive pictures repeats the one before, as in a video with a raised rate."""
    pairs = pairwise(shown)
    changes = [float(cv2.norm(a, b, cv2.NORM_L1)) / a.size for a, b in pairs]
    return min(changes) <= REPEATED * float(np.median(changes))
