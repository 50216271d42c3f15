"""Parts of frames in which something may move: a person, an animal, a vehicle or a screen is seen there.

Features are not looked for there, and the training needs less evidence of movement there
(`cleargs.formation.movement`). A kind that most frames show is the subject of the capture, as in a portrait.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from cleargs.capture.prepare import WorkFrame
from cleargs.files import make_folder, remove
from cleargs.media.image import read_mask, read_rgb, write_mask
from cleargs.progress import Reporter
from cleargs.types import ImageU8

SUBJECT = 0.75
"""Share of the frames that show a kind from which it is the subject."""
MOST = 0.5
"""Largest share of a frame in which features are left out; with more, the frame keeps all."""

Boxes = Sequence[tuple[str, int, int, int, int]]
"""Kind, left, top, right and bottom, px."""


def with_movers(
    frames: Sequence[WorkFrame], folder: Path, boxes: Callable[[ImageU8], Boxes], reporter: Reporter
) -> list[WorkFrame]:
    """Return the frames with what is seen in them that may move.

    If there is some, ``folder/features`` has a mask per frame for COLMAP: its mask without these parts.
    """
    with reporter.task("looking for people", len(frames)) as task:
        seen = []
        for frame in frames:
            seen.append(boxes(read_rgb(folder / "images" / frame.image)))
            task.advance()
    shown = Counter(kind for found in seen for kind in {box[0] for box in found})
    subjects = {kind for kind, number in shown.items() if number >= SUBJECT * len(frames)}
    marked = [
        replace(frame, movers=tuple(box[1:] for box in found if box[0] not in subjects))
        for frame, found in zip(frames, seen, strict=True)
    ]
    remove(folder / "features")
    count = sum(bool(frame.movers) for frame in marked)
    if count:
        kinds = ", ".join(sorted(shown.keys() - subjects))
        reporter.info(f"{count} of {len(frames)} frames show what may move ({kinds}): no features there")
        make_folder(folder / "features")
        for frame in marked:
            write_mask(folder / "features" / f"{frame.image}.png", _mask(frame, folder))
    return marked


def _mask(frame: WorkFrame, folder: Path) -> np.ndarray[tuple[int, int], np.dtype[np.uint8]]:
    own = read_mask(folder / "masks" / f"{frame.image}.png") if frame.masked else None
    mask = np.full((frame.height, frame.width), 255, np.uint8) if own is None else own
    without = mask.copy()
    for left, top, right, bottom in frame.movers or ():
        without[top:bottom, left:right] = 0
    return without if (without > 0).sum() >= (1 - MOST) * (mask > 0).sum() else mask
