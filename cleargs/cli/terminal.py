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
"""Time for an orderly exit after Ctrl-C."""

SAVING_S = 20.0
"""Time for an orderly exit after SIGTERM: a training ends its step and saves a checkpoint."""

INTERRUPTED_LINE = "interrupted: finished work is kept; give the same command again to resume"

_SIGNALS = (signal.SIGINT, signal.SIGTERM)
_COLOUR = re.compile(r"(\x1b\[[0-9;]*m)")  # the escapes that ClearGS itself writes


def handle_signals() -> None:
    """Turn SIGINT and SIGTERM into KeyboardInterrupt, and end the process if Python cannot raise it.

    Python raises it only between two of its instructions, so a long call of compiled code delays it. A
    waiting thread then ends the process after `GRACE_S` or `SAVING_S`. This is safe: results survive kill -9
    at any moment.
    """

    def interrupt(number: int, frame: FrameType | None) -> None:
        raise KeyboardInterrupt

    def restore() -> None:
        # A forked child shares the pipe. Without this, a signal to the child would end its parent too.
        signal.set_wakeup_fd(-1)
        signal.signal(signal.SIGTERM, signal.SIG_DFL)

    def end_after_signal() -> None:
        while True:
            if received := set(_SIGNALS).intersection(os.read(reader, 16)):
                time.sleep(GRACE_S if signal.SIGINT in received else SAVING_S)
                os.write(2, f"{INTERRUPTED_LINE}\n".encode())
                os._exit(130)

    # Signals wait until the handlers are installed. Signals that were blocked before stay blocked.
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
    """A text stream that escapes control and bidirectional characters: file names cannot control a terminal.

    Line ends, tabs and colours stay. Characters that the encoding of the stream lacks are escaped too.
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
    """Replace ``sys.stdout`` and ``sys.stderr`` by escaping streams, unless other code has replaced them."""
    for name in ("stdout", "stderr"):
        stream = getattr(sys, f"__{name}__")
        if isinstance(stream, io.TextIOWrapper) and getattr(sys, name) is stream:
            setattr(sys, name, EscapingStream(stream))
