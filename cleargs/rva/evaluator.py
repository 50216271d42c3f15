"""Protocol of the evaluators, which score the appearance of frames, and a cache of results per frame."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np

from cleargs.digest import file_digest
from cleargs.errors import InputError, StageError, StoreError
from cleargs.files import write_json
from cleargs.media.image import read_mask, read_rgb
from cleargs.progress import Reporter
from cleargs.rva.tables import CUE_COLUMNS
from cleargs.safe_io import read_json
from cleargs.types import ArrayF64, ImageU8, MaskU8


@dataclass(frozen=True)
class EvaluatedFrame:
    """A frame to evaluate, as files, so that not all images have to be in memory."""

    frame_id: int
    image: Path
    mask: Path | None = None
    """8-bit image of the same size; pixels with value 0 are ignored."""


def load_view(view: EvaluatedFrame) -> tuple[ImageU8, MaskU8 | None]:
    """Read the frame [H, W, 3] in sRGB and its mask [H, W].

    Raises StoreError if a file is unreadable, or if the mask and the image differ in size.
    """
    hint = "run again with --force ingest"
    try:
        rgb, mask = read_rgb(view.image), read_mask(view.mask) if view.mask else None
    except InputError as error:
        raise StoreError(str(error), hint=hint) from error
    if mask is not None and mask.shape != rgb.shape[:2]:
        raise StoreError(f"the mask {view.mask} differs in size from its image", hint=hint)
    return rgb, mask


class Evaluator(Protocol):
    """Estimates the eleven appearance cues of every frame of a capture."""

    @property
    def name(self) -> str:
        """Name of the evaluator in ``rva.evaluator``, with the name of its model if it has one."""

    @property
    def version(self) -> int:
        """Number that is raised if a change gives other cues for the same images."""

    def evaluate(self, views: Sequence[EvaluatedFrame], *, threads: int, reporter: Reporter) -> ArrayF64:
        """Return the cues [n, 11] in [0, 1] of frames, columns as `tables.CUE_COLUMNS`; NaN where unscored.

        Frames are in trajectory order. Their images are read one by one, so that memory does not grow with
        their number. The result does not depend on ``threads``. ``reporter`` receives the progress, and a
        warning for each frame that could not be scored.
        """


def evaluated(
    evaluator: Evaluator, views: Sequence[EvaluatedFrame], *, threads: int, reporter: Reporter
) -> ArrayF64:
    """Return the cues [n, 11] of frames, as `Evaluator.evaluate`; raise StageError if they are none."""
    cues = np.asarray(evaluator.evaluate(views, threads=threads, reporter=reporter), np.float64)
    expected = (len(views), len(CUE_COLUMNS))
    if cues.shape != expected or not bool((np.isnan(cues) | ((cues >= 0.0) & (cues <= 1.0))).all()):
        raise StageError(
            f"the evaluator {evaluator.name} returned no cues: an array of the shape {cues.shape}"
            + (", with values outside 0 to 1" if cues.shape == expected else f", not {expected}"),
            hint="correct its package, or set rva.evaluator to another one",
        )
    return cues


def label(evaluator: Evaluator) -> str:
    """Return the name of an evaluator in the tables."""
    return f"{evaluator.name}-{evaluator.version}"


@dataclass(frozen=True)
class ItemCache:
    """Cache of a row of numbers per frame, as JSON files named by a digest of all that determines the row."""

    folder: Path | None
    """Folder of the files; None: no cache."""
    columns: Sequence[str]
    """Names of the numbers in a row."""
    facts: Sequence[object]
    """JSON values that determine the rows together with the files of the frames."""
    bounds: tuple[float, float] = (-math.inf, math.inf)
    """Range of valid numbers. A file with a number outside it is not used."""

    def row(self, view: EvaluatedFrame, make: Callable[[EvaluatedFrame], ArrayF64]) -> ArrayF64:
        """Return the cached row of ``view``, or call ``make`` and store its row, atomically.

        Raises StoreError if a file of the frame is unreadable.
        """
        if self.folder is None:
            return make(view)
        try:
            parts = [file_digest(path) for path in (view.image, view.mask) if path]
        except OSError as error:
            raise StoreError(
                f"cannot read {error.filename}: {error.strerror or error}", hint="check that the file exists"
            ) from error
        digest = hashlib.sha256(json.dumps([*self.facts, *parts]).encode()).hexdigest()
        row = self.find(self.folder / f"{digest}.json")
        if row is None:
            row = make(view)
            self.folder.mkdir(parents=True, exist_ok=True)
            write_json(self.folder / f"{digest}.json", dict(zip(self.columns, row.tolist(), strict=True)))
        return row

    def find(self, file: Path) -> ArrayF64 | None:
        """Return the row in ``file``, or None if the file is missing or damaged."""
        try:
            kept = read_json(file)
            row = np.array([kept[column] for column in self.columns], dtype=np.float64)
        except (OSError, ValueError, KeyError, TypeError):
            return None
        low, high = self.bounds
        return row if bool((np.isfinite(row) & (row >= low) & (row <= high)).all()) else None
