"""Base class of the Qwen3-VL evaluators: it prepares images, caches scores and marks unscored frames.

The model gets each frame reduced to a maximum size, with masked pixels painted grey.
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
from cleargs.rva.evaluator import EvaluatedFrame, ItemCache, downscale, load_view
from cleargs.rva.tables import CUE_COLUMNS
from cleargs.types import ArrayF64, ImageU8

_MASKED = 127  # mid-grey, as the prompt says


@dataclass(frozen=True, eq=False)
class EncodedImage:
    """Image that the model gets."""

    rgb: ImageU8  # [h, w, 3] sRGB
    masked: bool
    """True if parts are painted grey."""

    def data_url(self) -> str:
        """Return the image as the data URL of a PNG. A lossy format would add artifacts."""
        _, png = cv2.imencode(".png", cv2.cvtColor(self.rgb, cv2.COLOR_RGB2BGR))
        return f"data:image/png;base64,{base64.b64encode(png.tobytes()).decode('ascii')}"


class UnscoredError(Exception):
    """No valid scores for one frame, with the reason. Other frames may still be scored."""


class QwenEvaluator(ABC):
    """Evaluator ``qwen3-vl``: scores each frame separately with the model of a subclass.

    Scores are cached as soon as they arrive, so that an interrupted evaluation resumes.
    """

    version = QwenConfig.prompt
    workers = 1
    """Number of images that are scored in parallel, each in its thread."""

    def __init__(self, config: QwenConfig, *, model: str, identity: str, cache: Path | None) -> None:
        """Prepare the cache in the folder ``cache`` (None: no cache).

        ``identity`` is everything except the image that determines the scores.
        """
        self.name = f"qwen3-vl:{model}:prompt"
        self._config = config
        self._model = model
        facts = [identity, self.version, config.image_size]
        self._cache = ItemCache(cache, CUE_COLUMNS, facts, bounds=(0.0, 1.0))

    @abstractmethod
    def check(self) -> None:
        """Raise InputError if the model is unavailable."""

    @abstractmethod
    def score(self, image: EncodedImage) -> ArrayF64:  # [11] in [0, 1], as tables.CUE_COLUMNS
        """Return the cues of one image.

        Raises UnscoredError if this image gets no scores, and StageError or InputError if no image would get
        scores.
        """

    def stop(self) -> None:  # noqa: B027
        """Stop work as soon as possible, if the subclass can. Called from another thread."""

    def evaluate(self, views: Sequence[EvaluatedFrame], *, threads: int, reporter: Reporter) -> ArrayF64:
        """Score all frames; see `Evaluator.evaluate`. ``threads`` is not used.

        Raises StageError if no frame could be scored.
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
        return self.score(EncodedImage(downscale(rgb, self._config.image_size), masked))
