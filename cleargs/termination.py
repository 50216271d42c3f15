"""SIGTERM during a long computation: the computation ends its step and saves before the process stops."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager


@contextmanager
def deferred_sigterm() -> Iterator[Callable[[], bool]]:
    """Hold SIGTERM back for the block, and yield a function that returns True once it came.

    The block is expected to save its state and to raise KeyboardInterrupt then. A cluster sends SIGTERM
    before a time limit, so that a job can save. Nothing is held back outside the main thread, where Python
    runs no signal handlers, nor in a program that does not answer SIGTERM itself.
    """
    requested = threading.Event()
    in_main_thread = threading.current_thread() is threading.main_thread()
    before = signal.getsignal(signal.SIGTERM)
    if not in_main_thread or not callable(before):
        yield requested.is_set
        return
    signal.signal(signal.SIGTERM, lambda number, frame: requested.set())
    try:
        yield requested.is_set
    finally:
        signal.signal(signal.SIGTERM, before)
