"""Files that somebody else wrote: opened only where they are regular, read only up to a stated size, and
their text made harmless for a terminal.

A FIFO or a device in place of a file would block its reader, or never end; a size, a count or a depth that a
file only claims would take all memory.
"""

from __future__ import annotations

import errno
import json
import os
import stat
import struct
import unicodedata
from io import BufferedReader
from pathlib import Path
from typing import Any

from cleargs.errors import InputError

MAX_BYTES = 4 * 2**30
"""Most bytes of a file that is read as a whole (an image, a sparse model, a scene, a network)."""

MAX_TEXT_BYTES = 256 * 2**20
"""Most bytes of a document (JSON, TOML, CSV); transforms.json of 100,000 frames has 80 MB."""

FAULTS: tuple[type[Exception], ...] = (
    OSError,
    ValueError,  # UnicodeDecodeError and JSONDecodeError are such
    TypeError,
    LookupError,
    AttributeError,
    ArithmeticError,  # OverflowError and ZeroDivisionError are such
    RecursionError,
    struct.error,
)
"""What decoding a file of the wrong form may raise. Readers catch these where they say what they read."""


_HARMFUL = ("Cc", "Cs", "Zl", "Zp")
"""Unicode categories that a terminal acts on, or cannot show: control characters, halves of surrogates, line
and paragraph separators."""

_BIDI = frozenset("\u061c\u200e\u200f\u202a\u202b\u202c\u202d\u202e\u2066\u2067\u2068\u2069")
"""They reorder what stands around them, so that a name may read as another."""

TOO_DEEP = "it is nested too deeply"


def open_regular(path: Path) -> BufferedReader:
    """Open the regular file at ``path``, or the one that it links to, for reading.

    Raises OSError: there is no such file, it may not be read, or it is a folder, a FIFO or a device.
    """
    if "\0" in str(path):
        raise OSError(errno.EINVAL, "the name holds a zero byte", str(path))
    # Without O_NONBLOCK the call itself would wait for a FIFO's writer.
    handle = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    try:
        if not stat.S_ISREG(os.fstat(handle).st_mode):
            raise OSError(errno.EINVAL, "it is no regular file", str(path))
        return os.fdopen(handle, "rb")
    except BaseException:
        os.close(handle)
        raise


def read_bytes(path: Path, at_most: int = MAX_BYTES) -> bytes:
    """The content of the regular file at ``path``. Raises OSError for none such, and a larger one."""
    with open_regular(path) as file:
        size = os.fstat(file.fileno()).st_size
        if size > at_most:
            raise OSError(errno.EFBIG, f"it has {size} bytes, at most {at_most} are read", str(path))
        return file.read(at_most)


def read_text(path: Path) -> str:
    """The UTF-8 text at ``path``, without a byte order mark. Raises OSError like `read_bytes`, and
    UnicodeDecodeError.
    """
    return read_bytes(path, MAX_TEXT_BYTES).decode("utf-8-sig")


def read_json(path: Path) -> Any:
    """The JSON document at ``path``. Raises OSError like `read_bytes`, ValueError where it is no JSON."""
    try:
        return json.loads(read_bytes(path, MAX_TEXT_BYTES))
    except RecursionError:
        raise ValueError(TOO_DEEP) from None


def cause(error: Exception) -> str:
    """Why a file cannot be read, in one line without its path: what one of `FAULTS` says."""
    if isinstance(error, OSError):
        return error.strerror or str(error)
    if isinstance(error, KeyError):
        return f"{error.args[0]!r} is missing" if error.args else "something is missing"
    for kind, words in (
        (UnicodeDecodeError, "it is not UTF-8 text"),
        (struct.error, "it breaks off"),
        (OverflowError, "a number is too large"),
        (ZeroDivisionError, "a number is zero that must not be"),
        (RecursionError, TOO_DEEP),
    ):
        if isinstance(error, kind):
            return words
    return (str(error).splitlines() or [type(error).__name__])[0]


def printable(text: str, keep: str = "") -> str:
    r"""``text`` with control, bidirectional and undecodable characters (but those in ``keep``) as ``\u001b``.

    Names come from files: an escape sequence in one could write the clipboard, clear the screen or forge a
    line. The form is JSON's, so that escaped JSON is the same document.
    """
    if text.isascii() and text.isprintable():
        return text
    acting = {c for c in text if unicodedata.category(c) in _HARMFUL or c in _BIDI}.difference(keep)
    return "".join(f"\\u{ord(character):04x}" if character in acting else character for character in text)


def require_utf8(path: Path | str) -> None:
    """Raise InputError where the name of ``path`` is not UTF-8: no table and no report could hold it."""
    try:
        str(path).encode()
    except UnicodeEncodeError as error:
        raise InputError(f"the name of {path} is not UTF-8", hint="rename it") from error
