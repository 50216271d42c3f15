"""Arrays of one shape through a network on a GPU, as many at a time as fit."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from cleargs.errors import StageError

Floats = NDArray[np.float32]

PIXELS = 8 * 512 * 512
"""Pixels of a batch, at most."""

_EXHAUSTED = ("out of memory", "allocate memory", "alloc_failed")
"""How onnxruntime, CUDA and cuDNN say it; onnxruntime has no exception of its own for it."""


def in_batches(run: Callable[[Floats], Floats], items: Sequence[Floats], pixels: int) -> list[Floats]:
    """The results of ``run`` for ``items``, in their order.

    run: maps a stack [N, ...] of items to one of their results [N, ...].
    pixels: how many an item has.

    A batch that the device's memory does not hold is tried again by halves. Raises StageError when a single
    item is too large.
    """
    size = max(1, PIXELS // pixels)
    results: list[Floats] = []
    while len(results) < len(items):
        batch = np.stack(items[len(results) : len(results) + size])
        try:
            results.extend(run(batch))
        except Exception as error:  # onnxruntime's exceptions share no base class of their own
            if not any(words in str(error).lower() for words in _EXHAUSTED):
                raise
            if len(batch) == 1:
                raise StageError(
                    f"the GPU's memory does not hold a network's work on {pixels} pixels",
                    hint="free memory on the GPU, or use --device cpu",
                ) from error
            size = len(batch) // 2
    return results
