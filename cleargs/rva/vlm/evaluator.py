"""The evaluator ``qwen3-vl``: it prepares images, caches scores and marks unscored frames.

The model gets each frame reduced to a maximum size, with masked pixels painted grey.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path

import numpy as np

from cleargs.errors import StageError
from cleargs.media.image import reduced
from cleargs.progress import Reporter
from cleargs.rva.config import QwenConfig
from cleargs.rva.evaluator import EvaluatedFrame, ItemCache, load_view
from cleargs.rva.tables import CUE_COLUMNS
from cleargs.rva.vlm.server import QwenServer, UnscoredError
from cleargs.types import ArrayF64

_MASKED = 127  # mid-grey, as the prompt says
_LONG_SIDE = 1024  # px; larger images are reduced to it


class QwenEvaluator:
    """Evaluator ``qwen3-vl``: scores each frame separately, several of them at the same time.

    Scores are cached as soon as they arrive, so that an interrupted evaluation resumes.
    """

    version = QwenConfig.prompt

    def __init__(self, config: QwenConfig, *, seed: int, cache: Path | None) -> None:
        """Prepare the client of the server, and the cache in the folder ``cache`` (None: no cache).

        Raises InputError if the server's address or key is invalid.
        """
        self.name = f"qwen3-vl:{config.model}:prompt"
        self._config = config
        self.server = QwenServer(config, seed=seed)
        identity = json.dumps(["server", config.model, config.max_tokens, seed])
        facts = [identity, self.version, _LONG_SIDE]
        self._cache = ItemCache(cache, CUE_COLUMNS, facts, bounds=(0.0, 1.0))

    def evaluate(self, views: Sequence[EvaluatedFrame], *, threads: int, reporter: Reporter) -> ArrayF64:
        """Score all frames; see `Evaluator.evaluate`. ``threads`` is not used.

        Raises StageError if no frame could be scored.
        """
        cues = np.full((len(views), len(CUE_COLUMNS)), np.nan)
        faults: dict[int, str] = {}
        pool = ThreadPoolExecutor(self._config.concurrency)
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
            self.server.stop()
            pool.shutdown(wait=False, cancel_futures=True)
            raise
        pool.shutdown()
        if faults and len(faults) == len(views):
            raise StageError(
                f"{self._config.model} scored no frame: {faults[0]}",
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
        return self.server.score(reduced(rgb, _LONG_SIDE), masked=masked)
