"""Launching parallel kernels from Python."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numba

TILES_PER_CHUNK = 8
"""Tiles handed to a thread at a time: real scenes are uneven, so the queue must be finer than the threads."""

# The threads are one resource of the process: Numba's work queue, the layer where OpenMP is missing, aborts
# when two Python threads launch kernels at once.
_LAUNCH_LOCK = threading.RLock()


@contextmanager
def exclusive() -> Iterator[None]:
    """Hold the launch lock around a group of kernels."""
    with _LAUNCH_LOCK:
        yield


@contextmanager
def uneven_work() -> Iterator[None]:
    """Hand out the kernel's work in small chunks."""
    with numba.parallel_chunksize(TILES_PER_CHUNK):
        yield


def set_threads(n: int) -> None:
    """See ``runtime.set_threads``."""
    if n < 1:
        raise ValueError(f"{n} threads")
    settings: Any = numba.config
    numba.set_num_threads(min(n, settings.NUMBA_NUM_THREADS))


def threads() -> int:
    """Number of threads that kernels run on."""
    return int(numba.get_num_threads())
