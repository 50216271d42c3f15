"""Deferral of SIGTERM, so that a training can save its state before it stops."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager


@contextmanager
def deferred_sigterm() -> Iterator[Callable[[], bool]]:
    """Defer SIGTERM within the block, and yield a function that returns True after a SIGTERM.

    The block then saves its state and raises KeyboardInterrupt. Clusters send SIGTERM before a time limit, so
    that a job can save. Signals are not deferred outside the main thread, where Python runs no signal
    handlers, or if the program has no handler for SIGTERM.
    """
    received = threading.Event()
    in_main_thread = threading.current_thread() is threading.main_thread()
    before = signal.getsignal(signal.SIGTERM)
    if not in_main_thread or not callable(before):
        yield received.is_set
        return
    signal.signal(signal.SIGTERM, lambda number, frame: received.set())
    try:
        yield received.is_set
    finally:
        signal.signal(signal.SIGTERM, before)
