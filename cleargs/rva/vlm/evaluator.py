"""Frames in, cues out: keeps what is scored, resumes after a kill, marks what could not be scored.

A model meets a frame as a picture: reduced to a stated size, masked pixels painted over, never enlarged.
A server or a model in process answers the prompt about it.
"""

from __future__ import annotations

import base64
from abc import ABC, abstractmethod
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from cleargs.errors import StageError
from cleargs.progress import Reporter
from cleargs.rva.config import QwenConfig
from cleargs.rva.evaluator import EvaluatedFrame, ItemCache, load_view, reduced
from cleargs.rva.tables import CUE_COLUMNS
from cleargs.types import ArrayF64, ImageU8

_MASKED = 127  # mid-grey, as the prompt calls it


@dataclass(frozen=True, eq=False)
class EncodedImage:
    """What is shown to a model."""

    rgb: ImageU8  # [h, w, 3] sRGB
    masked: bool
    """Whether parts are painted grey."""

    def data_url(self) -> str:
        """As PNG: a lossy format would add artifacts of its own to those that are judged."""
        _, png = cv2.imencode(".png", cv2.cvtColor(self.rgb, cv2.COLOR_RGB2BGR))
        return f"data:image/png;base64,{base64.b64encode(png.tobytes()).decode('ascii')}"


class UnscoredError(Exception):
    """A frame got no valid scores, for the reason given; other frames may."""


class QwenEvaluator(ABC):
    """Evaluator ``qwen3-vl``: each frame alone, by the vision-language model of a subclass.

    Scores are kept in ``cache``, one file a picture, as they come: a second call asks for the others only.
    """

    version = QwenConfig.prompt
    workers = 1
    """How many pictures the model takes at once, each in a thread of its own."""

    def __init__(self, config: QwenConfig, *, model: str, identity: str, cache: Path | None) -> None:
        """``identity`` is whatever decides the scores next to the picture: they are kept under it."""
        self.name = f"qwen3-vl:{model}:prompt"
        self._config = config
        self._model = model
        facts = [identity, self.version, config.image_size]
        self._cache = ItemCache(cache, CUE_COLUMNS, facts, bounds=(0.0, 1.0))

    @abstractmethod
    def check(self) -> None:
        """Raise InputError where the model cannot be had."""

    @abstractmethod
    def score(self, picture: EncodedImage) -> ArrayF64:  # [11] in [0, 1], as tables.CUE_COLUMNS
        """The cues of one picture.

        Raises UnscoredError where this picture gets none, StageError or InputError where no picture would.
        """

    def stop(self) -> None:  # noqa: B027
        """Give up what is under way as soon as possible, where a subclass can; called from another thread."""

    def evaluate(self, views: Sequence[EvaluatedFrame], *, threads: int, reporter: Reporter) -> ArrayF64:
        """See `Evaluator.evaluate`. ``threads`` is not used: the work is done elsewhere or has its own.

        Raises StageError when no frame at all could be scored.
        """
        cues = np.full((len(views), len(CUE_COLUMNS)), np.nan)
        faults: dict[int, str] = {}
        pool = ThreadPoolExecutor(self.workers)
        try:
            with reporter.task("cues", total=len(views)) as task:
                rows = {pool.submit(self._cache.row, view, self._score): k for k, view in enumerate(views)}
                for future in as_completed(rows):
                    try:
                        cues[rows[future]] = future.result()
                    except UnscoredError as fault:
                        faults[rows[future]] = str(fault)
                    task.advance()
        except BaseException:
            self.stop()
            pool.shutdown(wait=False, cancel_futures=True)
            raise
        pool.shutdown()
        if faults and len(faults) == len(views):
            raise StageError(
                f"{self._model} scored no frame: {faults[0]}",
                hint="check the server and rva.qwen, or use --set rva.evaluator=statistics",
            )
        for row in sorted(faults):
            reporter.warn(f"frame {views[row].frame_id} was not scored: {faults[row]}")
        return cues

    def _score(self, view: EvaluatedFrame) -> ArrayF64:
        rgb, mask = load_view(view)
        if mask is not None:
            rgb = np.where(mask[..., None] > 0, rgb, np.uint8(_MASKED))
        masked = mask is not None and not mask.all()
        return self.score(EncodedImage(reduced(rgb, self._config.image_size), masked))
