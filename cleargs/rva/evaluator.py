"""Who judges the appearance of a frame: the protocol that all evaluators follow, and what was found out about
single frames, kept so that adding frames to a capture costs only those.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
import numpy.typing as npt

from cleargs.errors import InputError, StoreError
from cleargs.files import write_json
from cleargs.media.image import read_mask, read_rgb
from cleargs.progress import Reporter
from cleargs.rva.arrays import Floats
from cleargs.untrusted import read_json


@dataclass(frozen=True)
class View:
    """A frame as an evaluator gets it: files, so that nobody has to hold a video in memory."""

    frame_id: int
    image: Path
    mask: Path | None = None
    """8-bit image of the same size; pixels that are 0 in it are ignored."""


def load_view(view: View) -> tuple[npt.NDArray[np.uint8], npt.NDArray[np.uint8] | None]:
    """The frame [H, W, 3] in sRGB and its mask [H, W]. Raises StoreError when one cannot be read."""
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
        """What the user calls it in ``rva.evaluator``, with the model it asks where there is one."""

    @property
    def version(self) -> int:
        """Raised when equal images get other cues."""

    def evaluate(self, views: Sequence[View], *, threads: int, reporter: Reporter) -> Floats:
        """Cues [n, 11] in [0, 1], columns as `tables.CUE_COLUMNS`, for frames given in trajectory order.

        A row of NaN is a frame that could not be scored; ``reporter`` was told why. Neighbours in ``views``
        are neighbours in the video. Images are read as they are needed: memory does not grow with their
        number. The result does not depend on ``threads``.
        """


def label(evaluator: Evaluator) -> str:
    """How the tables name an evaluator."""
    return f"{evaluator.name}-{evaluator.version}"


class ItemCache:
    """Rows of numbers with named columns, a JSON file each, named by the digest of all that decides them."""

    def __init__(self, folder: Path, columns: Sequence[str]) -> None:
        self._folder = folder
        self._columns = columns

    def find(self, digest: str) -> Floats | None:
        """The row; None where there is none, or where its file is damaged."""
        try:
            kept = read_json(self._folder / f"{digest}.json")
            row = np.array([kept[column] for column in self._columns], dtype=np.float64)
        except (OSError, ValueError, KeyError, TypeError):
            return None
        return row if bool(np.isfinite(row).all()) else None

    def add(self, digest: str, row: Floats) -> None:
        """Keep ``row``; the file appears whole."""
        self._folder.mkdir(parents=True, exist_ok=True)
        write_json(self._folder / f"{digest}.json", dict(zip(self._columns, row.tolist(), strict=True)))


def view_digest(facts: Sequence[object], view: View) -> str:
    """Names what is found out about the files of ``view`` in the light of ``facts`` (JSON values).

    Raises OSError when a file cannot be read.
    """
    parts = [hashlib.sha256(path.read_bytes()).hexdigest() for path in (view.image, view.mask) if path]
    return hashlib.sha256(json.dumps([*facts, *parts]).encode()).hexdigest()
