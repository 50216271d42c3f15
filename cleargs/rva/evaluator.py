"""Who judges the appearance of a frame: the protocol that all evaluators follow, and what was found out about
single frames, kept so that adding frames to a capture costs only those.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import cv2
import numpy as np

from cleargs.errors import InputError, StoreError
from cleargs.files import write_json
from cleargs.media.image import read_mask, read_rgb
from cleargs.progress import Reporter
from cleargs.safe_io import read_json
from cleargs.types import AnyImage, ArrayF64, ImageU8, MaskU8


@dataclass(frozen=True)
class EvaluatedFrame:
    """A frame as an evaluator gets it: files, so that nobody has to hold a video in memory."""

    frame_id: int
    image: Path
    mask: Path | None = None
    """8-bit image of the same size; pixels that are 0 in it are ignored."""


def load_view(view: EvaluatedFrame) -> tuple[ImageU8, MaskU8 | None]:
    """The frame [H, W, 3] in sRGB and its mask [H, W]. Raises StoreError when one cannot be read."""
    hint = "run again with --force ingest"
    try:
        rgb, mask = read_rgb(view.image), read_mask(view.mask) if view.mask else None
    except InputError as error:
        raise StoreError(str(error), hint=hint) from error
    if mask is not None and mask.shape != rgb.shape[:2]:
        raise StoreError(f"the mask {view.mask} differs in size from its image", hint=hint)
    return rgb, mask


def reduced(image: AnyImage, long_side: int) -> AnyImage:
    """``image``, by area averaging where its long side exceeds ``long_side`` px."""
    height, width = image.shape[:2]
    scale = long_side / max(height, width)
    if scale >= 1.0:
        return image
    size = max(1, round(width * scale)), max(1, round(height * scale))
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA)


class Evaluator(Protocol):
    """Estimates the eleven appearance cues of every frame of a capture."""

    @property
    def name(self) -> str:
        """What the user calls it in ``rva.evaluator``, with the model it asks where there is one."""

    @property
    def version(self) -> int:
        """Raised when equal images get other cues."""

    def evaluate(self, views: Sequence[EvaluatedFrame], *, threads: int, reporter: Reporter) -> ArrayF64:
        """Cues [n, 11] in [0, 1], columns as `tables.CUE_COLUMNS`, for frames given in trajectory order.

        A row of NaN is a frame that could not be scored; ``reporter`` was told why. Neighbours in ``views``
        are neighbours in the video. Images are read as they are needed: memory does not grow with their
        number. The result does not depend on ``threads``.
        """


def label(evaluator: Evaluator) -> str:
    """How the tables name an evaluator."""
    return f"{evaluator.name}-{evaluator.version}"


@dataclass(frozen=True)
class ItemCache:
    """Rows of numbers with named columns, a JSON file each, named by the digest of all that decides them."""

    folder: Path | None
    """None: nothing is kept."""
    columns: Sequence[str]
    facts: Sequence[object]
    """JSON values that decide the rows next to the files of the views."""
    bounds: tuple[float, float] = (-math.inf, math.inf)
    """Rows with a number outside are not taken from files."""

    def row(self, view: EvaluatedFrame, make: Callable[[EvaluatedFrame], ArrayF64]) -> ArrayF64:
        """The kept row of ``view``, or else what ``make`` finds; a new file appears whole.

        Raises OSError when a file of the view cannot be read.
        """
        if self.folder is None:
            return make(view)
        parts = [hashlib.sha256(path.read_bytes()).hexdigest() for path in (view.image, view.mask) if path]
        digest = hashlib.sha256(json.dumps([*self.facts, *parts]).encode()).hexdigest()
        row = self.find(self.folder / f"{digest}.json")
        if row is None:
            row = make(view)
            self.folder.mkdir(parents=True, exist_ok=True)
            write_json(self.folder / f"{digest}.json", dict(zip(self.columns, row.tolist(), strict=True)))
        return row

    def find(self, file: Path) -> ArrayF64 | None:
        """The row in ``file``; None where there is none, or where it is damaged."""
        try:
            kept = read_json(file)
            row = np.array([kept[column] for column in self.columns], dtype=np.float64)
        except (OSError, ValueError, KeyError, TypeError):
            return None
        low, high = self.bounds
        return row if bool((np.isfinite(row) & (row >= low) & (row <= high)).all()) else None
