"""Standard output and error as all commands write to them: no text from a file steers the terminal."""

from __future__ import annotations

import io
import re
import sys

from cleargs.text import printable

_COLOUR = re.compile(r"(\x1b\[[0-9;]*m)")
"""What our own tables are coloured with. It changes how the text after it looks, and nothing else."""


class EscapingStream(io.TextIOWrapper):
    """A text stream that shows control and bidirectional characters instead of passing them on.

    Lines, tabs and colours stay. A character that the stream's encoding lacks is shown in the same way.
    """

    def write(self, text: str) -> int:
        parts = _COLOUR.split(text)
        parts[::2] = [printable(part, keep="\n\r\t") for part in parts[::2]]
        super().write("".join(parts))
        return len(text)


def protect_streams() -> None:
    """Let ``sys.stdout`` and ``sys.stderr`` escape; streams that somebody else put there are left alone."""
    if isinstance(sys.__stdout__, io.TextIOWrapper) and sys.stdout is sys.__stdout__:
        sys.stdout = _escaping(sys.__stdout__)
    if isinstance(sys.__stderr__, io.TextIOWrapper) and sys.stderr is sys.__stderr__:
        sys.stderr = _escaping(sys.__stderr__)


def _escaping(stream: io.TextIOWrapper) -> io.TextIOWrapper:
    stream.flush()
    return EscapingStream(
        stream.buffer,
        encoding=stream.encoding,
        errors="backslashreplace",
        line_buffering=stream.line_buffering,
        write_through=stream.write_through,
    )
