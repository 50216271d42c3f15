"""Signals and standard streams of the process that runs a command."""

from __future__ import annotations

import io
import os
import re
import signal
import sys
import threading
import time
from types import FrameType

from cleargs.safe_io import printable

GRACE_S = 1.0
"""Time that the ordinary way out may take after Ctrl-C."""

SAVING_S = 20.0
"""Time that it may take after SIGTERM: a training ends its step and saves a checkpoint."""

INTERRUPTED = "interrupted; finished work is kept, and the same command resumes from there"

_SIGNALS = (signal.SIGINT, signal.SIGTERM)
_COLOUR = re.compile(r"(\x1b\[[0-9;]*m)")  # of our own tables: it changes how the text after it looks


def answer_signals() -> None:
    """Turn SIGINT and SIGTERM into KeyboardInterrupt, with a way out for when Python cannot raise it.

    Python raises it only between two of its instructions, so a long call into compiled code would delay
    it. A waiting thread then ends the process after `GRACE_S` or `SAVING_S`. That is safe for the results:
    they survive kill -9 at any moment.
    """

    def interrupt(number: int, frame: FrameType | None) -> None:
        raise KeyboardInterrupt

    def restore() -> None:
        # A forked child shares the pipe: without this, ending it would end us.
        signal.set_wakeup_fd(-1)
        signal.signal(signal.SIGTERM, signal.SIG_DFL)

    def end_after_signal() -> None:
        while True:
            if received := set(_SIGNALS).intersection(os.read(reader, 16)):
                time.sleep(GRACE_S if signal.SIGINT in received else SAVING_S)
                os.write(2, f"{INTERRUPTED}\n".encode())
                os._exit(130)

    # A signal waits until all is in place. What was blocked before stays blocked.
    before = signal.pthread_sigmask(signal.SIG_BLOCK, _SIGNALS)
    os.register_at_fork(after_in_child=restore)
    for number in _SIGNALS:
        signal.signal(number, interrupt)
    reader, writer = os.pipe()
    os.set_blocking(writer, False)
    signal.set_wakeup_fd(writer, warn_on_full_buffer=False)
    threading.Thread(target=end_after_signal, name="interrupt", daemon=True).start()
    signal.pthread_sigmask(signal.SIG_SETMASK, before)


class EscapingStream(io.TextIOWrapper):
    """A text stream that shows control and bidirectional characters instead of passing them on.

    Lines, tabs and colours stay. A character that the stream's encoding lacks is shown in the same way.
    """

    def __init__(self, stream: io.TextIOWrapper) -> None:
        stream.flush()
        super().__init__(
            stream.buffer,
            stream.encoding,
            "backslashreplace",
            line_buffering=stream.line_buffering,
            write_through=stream.write_through,
        )

    def write(self, text: str) -> int:
        parts = _COLOUR.split(text)
        parts[::2] = [printable(part, keep="\n\r\t") for part in parts[::2]]
        super().write("".join(parts))
        return len(text)


def protect_streams() -> None:
    """Let ``sys.stdout`` and ``sys.stderr`` escape; streams that somebody else put there are left alone."""
    for name in ("stdout", "stderr"):
        stream = getattr(sys, f"__{name}__")
        if isinstance(stream, io.TextIOWrapper) and getattr(sys, name) is stream:
            setattr(sys, name, EscapingStream(stream))
