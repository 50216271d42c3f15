"""Ctrl-C and SIGTERM, answered within two seconds whatever the program is doing."""

from __future__ import annotations

import os
import signal
import threading
import time
from types import FrameType

GRACE = 1.0
"""Seconds that the ordinary way out may take."""

MESSAGE = b"interrupted; finished work is kept, and the same command resumes from there\n"

SIGNALS = (signal.SIGINT, signal.SIGTERM)


def answer_signals() -> None:
    """Turn SIGINT and SIGTERM into KeyboardInterrupt, with a way out for when Python cannot raise it.

    Python raises it only between two of its instructions, so a long call into compiled code would delay
    it. A waiting thread then ends the process after `GRACE` seconds. That is safe for the results: they
    survive kill -9 at any moment.
    """

    def interrupt(number: int, frame: FrameType | None) -> None:
        raise KeyboardInterrupt

    def restore() -> None:
        # A forked child shares the pipe: without this, ending it would end us.
        signal.set_wakeup_fd(-1)
        signal.signal(signal.SIGTERM, signal.SIG_DFL)

    # Until all is in place a signal waits: it is raised at the end, where the caller expects it.
    before = signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)
    os.register_at_fork(after_in_child=restore)
    signal.signal(signal.SIGINT, interrupt)
    signal.signal(signal.SIGTERM, interrupt)
    reader, writer = os.pipe()
    os.set_blocking(writer, False)
    signal.set_wakeup_fd(writer, warn_on_full_buffer=False)
    threading.Thread(target=_end_after_signal, args=(reader,), name="interrupt", daemon=True).start()
    signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _end_after_signal(reader: int) -> None:
    while True:
        numbers = os.read(reader, 16)
        if signal.SIGINT in numbers or signal.SIGTERM in numbers:
            time.sleep(GRACE)
            os.write(2, MESSAGE)
            os._exit(130)
