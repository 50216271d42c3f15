"""Frames in, cues out: keeps what is scored, resumes after a kill, marks what could not be scored.

A model meets a frame as a picture: reduced to a stated size, masked pixels painted over, never enlarged.
A server or a model in process answers the prompt about it.
"""

from __future__ import annotations

import base64
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import cv2
import numpy as np
import numpy.typing as npt

from cleargs.errors import StageError
from cleargs.progress import Reporter
from cleargs.rva.arrays import Floats
from cleargs.rva.config import QwenConfig
from cleargs.rva.evaluator import ItemCache, View, load_view, view_digest
from cleargs.rva.tables import CUE_COLUMNS

_MASKED = 127  # mid-grey, as the prompt calls it


@dataclass(frozen=True, eq=False)
class Picture:
    """What is shown to a model."""

    rgb: npt.NDArray[np.uint8]  # [h, w, 3] sRGB
    masked: bool
    """Whether parts are painted grey."""

    def data_url(self) -> str:
        """As PNG: a lossy format would add artifacts of its own to those that are judged."""
        _, png = cv2.imencode(".png", cv2.cvtColor(self.rgb, cv2.COLOR_RGB2BGR))
        return f"data:image/png;base64,{base64.b64encode(png.tobytes()).decode('ascii')}"


def load_picture(view: View, long_side: int) -> Picture:
    """Read a frame and its mask; reduce by area averaging to ``long_side`` px where it is larger.

    Raises StoreError when one cannot be read.
    """
    rgb, mask = load_view(view)
    if mask is not None:
        rgb = np.where(mask[..., None] > 0, rgb, np.uint8(_MASKED))
    height, width = rgb.shape[:2]
    scale = long_side / max(height, width)
    if scale < 1.0:
        size = (max(1, round(width * scale)), max(1, round(height * scale)))
        rgb = np.asarray(cv2.resize(rgb, size, interpolation=cv2.INTER_AREA), np.uint8)
    return Picture(rgb, mask is not None and not mask.all())


class UnscoredError(Exception):
    """A frame got no valid scores, for the reason given; other frames may."""


class PictureScorer(Protocol):
    """A vision-language model that scores one picture at a time."""

    @property
    def model(self) -> str:
        """Its name, for the tables."""

    @property
    def identity(self) -> str:
        """Whatever decides its scores beside the picture: scores are kept under it."""

    @property
    def workers(self) -> int:
        """How many pictures it takes at once, each in a thread of its own."""

    def score(self, picture: Picture) -> Floats:  # [11] in [0, 1], as tables.CUE_COLUMNS
        """The cues of one picture.

        Raises UnscoredError where this picture gets none, StageError or InputError where no picture would.
        """

    def stop(self) -> None:
        """Give up what is under way as soon as possible; called from another thread."""


class QwenEvaluator:
    """Evaluator ``qwen3-vl``: each frame alone, by a vision-language model.

    Scores are kept in ``cache``, one file a picture, as they come: a second call asks for the others only.
    """

    version = QwenConfig.prompt

    def __init__(self, scorer: PictureScorer, *, image_size: int, cache: Path) -> None:
        self._scorer = scorer
        self._image_size = image_size
        self._cache = ItemCache(cache, CUE_COLUMNS)

    @property
    def name(self) -> str:
        """The evaluator, its model, and what its version counts: ``qwen3-vl:MODEL:prompt``."""
        return f"qwen3-vl:{self._scorer.model}:prompt"

    def evaluate(self, views: Sequence[View], *, threads: int, reporter: Reporter) -> Floats:
        """See `Evaluator.evaluate`. ``threads`` is not used: the work is done elsewhere or has its own.

        Raises StageError when no frame at all could be scored.
        """
        cues = np.full((len(views), len(CUE_COLUMNS)), np.nan)
        faults: dict[int, str] = {}
        pool = ThreadPoolExecutor(self._scorer.workers)
        try:
            with reporter.task("cues", total=len(views)) as task:
                rows = {pool.submit(self._score, view): row for row, view in enumerate(views)}
                for future in as_completed(rows):
                    try:
                        cues[rows[future]] = future.result()
                    except UnscoredError as fault:
                        faults[rows[future]] = str(fault)
                    task.advance()
        except BaseException:
            self._scorer.stop()
            pool.shutdown(wait=False, cancel_futures=True)
            raise
        pool.shutdown()
        if faults and len(faults) == len(views):
            raise StageError(
                f"{self._scorer.model} scored no frame: {faults[0]}",
                hint="check the server and rva.qwen, or use --set rva.evaluator=statistics",
            )
        for row in sorted(faults):
            reporter.warn(f"frame {views[row].frame_id} was not scored: {faults[row]}")
        return cues

    def _score(self, view: View) -> Floats:
        digest = view_digest([self._scorer.identity, QwenConfig.prompt, self._image_size], view)
        kept = self._cache.find(digest)
        if kept is not None and bool(((kept >= 0.0) & (kept <= 1.0)).all()):
            return kept
        cues = self._scorer.score(load_picture(view, self._image_size))
        self._cache.add(digest, cues)
        return cues
