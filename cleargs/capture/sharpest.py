"""How sharp a frame is beside its neighbours; of a video, the sharpest frame near each chosen time."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from cleargs.capture.capture import Capture
from cleargs.capture.layouts.video import video_frame
from cleargs.capture.prepare import reduced
from cleargs.errors import InputError
from cleargs.files import write_json
from cleargs.media.video import decode_grey, read_timeline
from cleargs.progress import Reporter
from cleargs.untrusted import FAULTS, read_json

CHOICE = "chosen.json"
"""In the folder of the working images: numbers of the frames that were chosen from the video."""

_BINOMIAL = np.array([1, 4, 6, 4, 1], np.float32)


def sharpest(capture: Capture, folder: Path, long_side: int, reporter: Reporter) -> Capture:
    """``capture`` with each frame of a video exchanged for the sharpest of those that are nearer to its time
    than to the time of another chosen frame; ties go to the earlier one.

    The video is decoded once, unless a killed run left its choice in ``folder``.
    """
    if capture.kind != "video":
        return capture
    source = capture.frames[0].path
    timeline = read_timeline(source)
    times = np.array([frame.pts for frame in capture.frames], np.float64)
    nearest = np.searchsorted((times[1:] + times[:-1]) / 2, timeline.pts)
    if len(nearest) == len(times):
        return capture
    chosen = _left_behind(folder / CHOICE, nearest, len(times))
    if chosen is None:
        best = np.full(len(times), -1.0)
        chosen = [0] * len(times)
        numbers = {pts: number for number, pts in enumerate(timeline.pts)}
        with reporter.task("looking for sharp frames", len(numbers)) as task:
            for pts, grey in decode_grey(source, numbers):
                number = numbers[pts]
                place, value = nearest[number], sharpness(reduced(grey, long_side))
                if value > best[place]:
                    best[place], chosen[place] = value, number
                task.advance()
        if (best < 0.0).any():
            raise InputError(
                f"{source.name}: of a stretch of it no frame can be decoded",
                hint="convert the video with ffmpeg, or cut the damaged part off",
            )
        write_json(folder / CHOICE, chosen)
    return replace(capture, frames=tuple(video_frame(source, timeline, number) for number in chosen))


def _left_behind(file: Path, nearest: NDArray[np.intp], count: int) -> list[int] | None:
    """The choice of a killed run, or None where there is none that fits."""
    try:
        chosen = [int(number) for number in read_json(file)]
        return chosen if nearest[chosen].tolist() == list(range(count)) else None
    except FAULTS:
        return None


def sharpness(image: NDArray[np.uint8]) -> float:  # [H, W, 3] RGB, or [H, W] grey
    """Variance of the Laplacian of the grey image after a binomial filter (5x5, sigma 1 px); 0 and up.

    It grows with the texture in view too, so it ranks neighbours, not a whole capture. Unfiltered it would
    rank noise first: of a frame and its blurred copy with noise of 4 levels, it takes the copy more often
    than not. All values are whole numbers below 2^24, so the sums are exact.
    """
    grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    smooth = cv2.sepFilter2D(grey, cv2.CV_32F, _BINOMIAL, _BINOMIAL)
    laplacian = np.asarray(cv2.Laplacian(smooth, cv2.CV_32F)).astype(np.int64)
    count = laplacian.size
    # The filter's weights sum to 256.
    return float(count * int((laplacian**2).sum()) - int(laplacian.sum()) ** 2) / count**2 / 256**2
