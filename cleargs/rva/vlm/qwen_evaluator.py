"""Frames in, cues out: keeps what is scored, resumes after a kill, marks what could not be scored."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path

import numpy as np

from cleargs.errors import StageError
from cleargs.progress import Reporter
from cleargs.rva.arrays import Floats
from cleargs.rva.evaluator import ItemCache, View, view_digest
from cleargs.rva.tables import CUE_COLUMNS
from cleargs.rva.vlm.picture import PictureScorer, UnscoredError, load_picture
from cleargs.rva.vlm.prompt import VERSION


class QwenEvaluator:
    """Evaluator ``qwen3-vl``: each frame alone, by a vision-language model.

    Scores are kept in ``cache``, one file a picture, as they come: a second call asks for the others only.
    """

    version = VERSION

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
        digest = view_digest([self._scorer.identity, VERSION, self._image_size], view)
        kept = self._cache.find(digest)
        if kept is not None and bool(((kept >= 0.0) & (kept <= 1.0)).all()):
            return kept
        cues = self._scorer.score(load_picture(view, self._image_size))
        self._cache.add(digest, cues)
        return cues
